"""The controller node: what its timer and receive interrupts do. Integers only."""

from enum import IntFlag

import numpy as np

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.record import Record
from firmware_py.calibration import Calibration, CalibrationError
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.mailbox import Mailbox
from firmware_py.state_machine import (
    CALIBRATED,
    DRIVE_ENABLED,
    ENABLE,
    FAULT_RESET,
    INPUTS_FRESH,
    NOMINAL,
    READY_TO_ENABLE,
    State,
    next_state,
)

EXECUTION_NS = 100_000
"""Execution time of a control period between timer and transmit, ns: assumed until it is measured."""

PHASE_NS = 500_000
"""How long after the sensor's sampling instant the controller's timer fires, ns."""

_EXECUTION_TIME_RAW = EXECUTION_NS * 200 // PERIOD_NS
_STATUS_PERIODS = 100
_OBSERVER_PERIODS = 10
_OBSERVER_PHASE = 7
_OBSERVER_PAGES = 7
_POSITION_UM = range(-10_000, 410_001)
_SETPOINT_0P1UM = range(-10_000, 4_010_001)
_LAST_USABLE_SENSOR_STATUS = 1
_COUNT_MAX = 0xFFFF


class Fault(IntFlag):
    """Fault bits, in the order of ControllerStatus."""

    FEEDBACK_LOST = 1 << 0
    FEEDBACK_CORRUPT = 1 << 1
    FEEDBACK_INVALID = 1 << 2
    SETPOINT_LOST = 1 << 3
    SETPOINT_CORRUPT = 1 << 4
    SETPOINT_INVALID = 1 << 5
    COMMAND_LOST = 1 << 6
    COMMAND_CORRUPT = 1 << 7
    DRIVE_STATUS_LOST = 1 << 8
    DRIVE_STATUS_CORRUPT = 1 << 9
    DRIVE_NOT_ENABLED = 1 << 10
    DRIVE_FAULT = 1 << 11
    CALIBRATION_INVALID = 1 << 12
    MAILBOX_OVERRUN = 1 << 13


_DRIVE_ENABLED_MASK, _DRIVE_ENABLED = 0x6F, 0x27
_CONTROLWORD_QUICK_STOP = 0x02
_CONTROLWORD_FAULT_RESET = 0x80
_CONTROLWORD_DISABLE_VOLTAGE = 0x00
_CONTROLWORD_SHUTDOWN = 0x06

_ENABLING_CONTROLWORDS = (  # CiA 402 statusword mask and value, the controlword that leads on from there
    (_DRIVE_ENABLED_MASK, _DRIVE_ENABLED, 0x0F),
    (0x4F, 0x40, _CONTROLWORD_SHUTDOWN),  # switch on disabled
    (0x6F, 0x21, 0x07),  # ready to switch on
    (0x6F, 0x23, 0x0F),  # switched on
    (0x6F, 0x07, _CONTROLWORD_QUICK_STOP),  # quick stop active: let it finish
)
_FAULT_MASK, _FAULT = 0x4F, 0x08
_STATUSWORD_FAULT_BIT = 0x08  # set while the fault reaction is active too


class Controller:
    """The firmware: mailboxes, state machine, control kernel, transmit.

    Parameters
    ----------
    contract : Contract
        The DBC.
    calibration_block : bytes
        As flashed; a damaged one keeps the controller in power-on.

    Attributes
    ----------
    record : Record
        One row per control period, raw integers.
    """

    name = "controller"

    def __init__(self, contract: Contract, calibration_block: bytes) -> None:
        self._contract = contract
        self._calibration_block = calibration_block
        self.accepts = frozenset(
            message.can_id
            for message in (
                contract.position_feedback,
                contract.position_setpoint,
                contract.controller_command,
                contract.drive_status,
                contract.bench_control,
            )
        )
        self.latched = self.accepts
        self.transmits = frozenset(
            message.can_id
            for message in (contract.drive_command, contract.controller_status, contract.observer_state)
        )
        self.record = Record(
            (
                "time_ns",
                "state",
                "faults",
                "setpoint_0p1um",
                "position_um",
                "target_velocity_0p25rpm",
                "flags",
                "v1",
                "v2",
                "v3",
                "z1",
                "z2",
                "z3",
                "z4",
            ),
            "q",
        )
        self._kernel_state = np.zeros(k.ST_SIZE, np.int32)
        self._io = np.zeros(k.IO_SIZE, np.int32)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on or reset: forget everything, check the calibration."""
        contract = self._contract
        self._feedback = Mailbox(contract.position_feedback, _feedback_plausible)
        self._setpoint = Mailbox(contract.position_setpoint, _setpoint_plausible)
        self._command = Mailbox(contract.controller_command)
        self._drive_status = Mailbox(contract.drive_status)
        self._mailboxes = {
            contract.position_feedback.can_id: self._feedback,
            contract.position_setpoint.can_id: self._setpoint,
            contract.controller_command.can_id: self._command,
            contract.drive_status.can_id: self._drive_status,
        }
        self._protect = contract.drive_command.protector().protect
        self._bench_reset = False
        self._state: int = State.POWER_ON
        self._faults = 0
        self._overrun_fault = 0
        self._cycle = 0
        self._armed = False
        self._reset_asked = False
        self._saturations = 0
        try:
            calibration = Calibration.from_bytes(self._calibration_block)
        except CalibrationError:
            self._calibration = None
            self._default_law = 0
        else:
            self._calibration = calibration.array()
            self._default_law = calibration.law
        self._io[k.IO_LAW] = self._default_law
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt: latch."""
        mailbox = self._mailboxes.get(frame.can_id)
        if mailbox is not None:
            mailbox.receive(frame)
            if mailbox.overruns:
                self._overrun_fault = int(Fault.MAILBOX_OVERRUN)
        else:
            self._bench_reset |= self._contract.bench_control.unpack(frame.data).command == BenchCommand.RESET
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt: one control period."""
        if self._bench_reset:
            self.on_start(now_ns)
        for mailbox in self._mailboxes.values():
            mailbox.poll()
        conditions = self._conditions()
        previous, self._state = self._state, next_state(self._state, conditions)
        if conditions & NOMINAL == NOMINAL and self._state != State.SAFE:
            self._faults = self._overrun_fault
        else:
            self._update_faults(left_run=previous == State.RUN)
        velocity = self._control(entered=previous != State.RUN) if self._state == State.RUN else 0
        drive_command = self._contract.drive_command
        payload = self._protect(drive_command.pack(self._controlword(conditions), velocity))
        send_ns = now_ns + EXECUTION_NS
        sends = [(send_ns, drive_command.frame(payload))]
        if self._cycle % _STATUS_PERIODS == 0:
            sends.append((send_ns, self._status_frame()))
        if self._cycle % _OBSERVER_PERIODS == _OBSERVER_PHASE:
            sends.append((send_ns, self._observer_frame()))
        self._write_record(now_ns, velocity)
        self._cycle += 1
        return Actions(next_period(now_ns + 1), tuple(sends))

    def _conditions(self) -> int:
        command, drive = self._command.value, self._drive_status.value
        enable = command is not None and command.enable == 1
        reset = command is not None and command.fault_reset == 1
        reset_edge, self._reset_asked = reset and not self._reset_asked, reset
        if self._state in (State.STANDBY, State.RUN):
            self._armed = self._armed or not enable
        else:
            self._armed = False
        stale = (
            self._feedback.stale or self._setpoint.stale or self._command.stale or self._drive_status.stale
        )
        drive_enabled = drive is not None and drive.statusword & _DRIVE_ENABLED_MASK == _DRIVE_ENABLED
        return (
            (CALIBRATED if self._calibration is not None else 0)
            | (0 if stale else INPUTS_FRESH)
            | (ENABLE if enable and self._armed else 0)
            | (DRIVE_ENABLED if drive_enabled else 0)
            | (FAULT_RESET if reset_edge else 0)
        )

    def _update_faults(self, left_run: bool) -> None:
        """Show what is wrong now; in the safe state also what led there."""
        drive = self._drive_status.value
        statusword = drive.statusword if drive is not None else 0
        faults = self._overrun_fault
        for mailbox, lost, corrupt, invalid in (
            (self._feedback, Fault.FEEDBACK_LOST, Fault.FEEDBACK_CORRUPT, Fault.FEEDBACK_INVALID),
            (self._setpoint, Fault.SETPOINT_LOST, Fault.SETPOINT_CORRUPT, Fault.SETPOINT_INVALID),
            (self._command, Fault.COMMAND_LOST, Fault.COMMAND_CORRUPT, 0),
            (self._drive_status, Fault.DRIVE_STATUS_LOST, Fault.DRIVE_STATUS_CORRUPT, 0),
        ):
            if mailbox.stale:
                faults |= lost | (corrupt if mailbox.corrupt else 0) | (invalid if mailbox.invalid else 0)
        if self._calibration is None:
            faults |= Fault.CALIBRATION_INVALID
        if statusword & _STATUSWORD_FAULT_BIT:
            faults |= Fault.DRIVE_FAULT
        if self._state == State.SAFE:
            if left_run and statusword & _DRIVE_ENABLED_MASK != _DRIVE_ENABLED:
                faults |= Fault.DRIVE_NOT_ENABLED
            faults |= self._faults
        self._faults = faults

    def _controlword(self, conditions: int) -> int:
        if self._state == State.SAFE:
            return _CONTROLWORD_QUICK_STOP
        drive = self._drive_status.value
        if drive is None:
            return _CONTROLWORD_DISABLE_VOLTAGE
        if drive.statusword & _FAULT_MASK == _FAULT:
            return _CONTROLWORD_FAULT_RESET if self._reset_asked else _CONTROLWORD_DISABLE_VOLTAGE
        if self._state != State.RUN and conditions & READY_TO_ENABLE != READY_TO_ENABLE:
            return _CONTROLWORD_SHUTDOWN
        for mask, value, controlword in _ENABLING_CONTROLWORDS:
            if drive.statusword & mask == value:
                return controlword
        return _CONTROLWORD_DISABLE_VOLTAGE

    def _control(self, entered: bool) -> int:
        io = self._io
        io[k.IO_SETPOINT] = self._setpoint.value.position
        io[k.IO_POSITION] = self._feedback.value.position
        if entered:
            io[k.IO_LAW] = self._command.value.control_law or self._default_law
            control_reset(self._calibration, self._kernel_state, io)
        control_step(self._calibration, self._kernel_state, io)
        if io[k.IO_FLAGS] & k.FLAG_SPEED_LIMITED:
            self._saturations = min(self._saturations + 1, _COUNT_MAX)
        return int(io[k.IO_TARGET_VELOCITY])

    def _status_frame(self) -> Frame:
        status = self._contract.controller_status
        overruns = sum(mailbox.overruns for mailbox in self._mailboxes.values())
        flags = {str(fault.name).lower(): int(bool(self._faults & fault)) for fault in Fault}
        payload = status.pack(
            state=self._state,
            control_law=int(self._io[k.IO_LAW]),
            execution_time=_EXECUTION_TIME_RAW,
            saturations=self._saturations,
            mailbox_overruns=min(overruns, _COUNT_MAX),
            **flags,
        )
        return status.frame(payload)

    def _observer_frame(self) -> Frame:
        observer = self._contract.observer_state
        page = self._cycle // _OBSERVER_PERIODS % _OBSERVER_PAGES
        value = int(self._kernel_state[k.ST_V1 + page])
        return observer.frame(observer.pack(page, self._cycle & 0xFFFF, value))

    def _write_record(self, now_ns: int, velocity: int) -> None:
        io = self._io.tolist()
        self.record.append(
            (
                now_ns,
                self._state,
                self._faults,
                io[k.IO_SETPOINT],
                io[k.IO_POSITION],
                velocity,
                io[k.IO_FLAGS],
                *self._kernel_state.tolist()[k.ST_V1 : k.ST_Z4 + 1],
            )
        )


def _feedback_plausible(value: tuple[int, ...]) -> bool:
    sensor_status, position = value
    return sensor_status <= _LAST_USABLE_SENSOR_STATUS and position in _POSITION_UM


def _setpoint_plausible(value: tuple[int, ...]) -> bool:
    return value[0] in _SETPOINT_0P1UM
