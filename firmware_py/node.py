"""The controller node: what its timer and receive interrupts do. Integers only."""

from functools import partial
from typing import Any

import numpy as np

from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.frame import Frame
from dbc.jit import entry_point
from dbc.messages import BenchCommand
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.record import Record
from firmware_py import mailbox, task
from firmware_py.calibration import Calibration, CalibrationError
from firmware_py.kernel import layout as k

EXECUTION_NS = 100_000
"""Execution time of a control period between timer and transmit, ns: assumed until it is measured."""

PHASE_NS = 500_000
"""How long after the sensor's sampling instant the controller's timer fires, ns."""

_EXECUTION_TIME_RAW = EXECUTION_NS * 200 // PERIOD_NS
_STATUS_PERIODS = 100
_OBSERVER_PERIODS = 10
_OBSERVER_PHASE = 7
_OBSERVER_PAGES = 7
_PLAUSIBLE_POSITION_UM = -10_000, 410_000
_PLAUSIBLE_SETPOINT_0P1UM = -10_000, 4_010_000
_USABLE_SENSOR_STATUS = 0, 1
_period, _receive = entry_point(task.period), entry_point(mailbox.receive)


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
        self._drive_command = contract.drive_command
        received: dict[
            MessageCodec[..., Any], dict[str, tuple[int, int]]
        ] = {  # in the order of `firmware_py.task`; raw values that may be used
            contract.position_feedback: {
                "sensor_status": _USABLE_SENSOR_STATUS,
                "position": _PLAUSIBLE_POSITION_UM,
            },
            contract.position_setpoint: {"position": _PLAUSIBLE_SETPOINT_0P1UM},
            contract.controller_command: {},
            contract.drive_status: {},
        }
        self._received_ids = [message.can_id for message in received]
        self._expectations = np.array([mailbox.expectation(*entry) for entry in received.items()])
        self.accepts = frozenset({*self._received_ids, contract.bench_control.can_id})
        self.latched = self.accepts
        self.transmits = frozenset(
            message.can_id
            for message in (contract.drive_command, contract.controller_status, contract.observer_state)
        )
        self._layout = contract.drive_command.protected_layout()
        self._row = np.zeros(len(task.RECORD_COLUMNS), np.int64)
        self.record = Record(task.RECORD_COLUMNS, "q")

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: forget everything, check the calibration."""
        self._empty_mailboxes()
        self._restart_task()
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt: latch. A reset forgets what came before it, not what comes after."""
        row = self._rows.get(frame.can_id)
        if row is not None:
            _receive(row, frame.data, frame.dlc)
        elif self._contract.bench_control.unpack(frame.data).command == BenchCommand.RESET:
            self._empty_mailboxes()
            self._bench_reset = True
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt: one control period."""
        if self._bench_reset:
            self._restart_task()
        payload = self._period(now_ns)
        self.record.append_array(self._row)
        send_ns = now_ns + EXECUTION_NS
        sends = [(send_ns, self._drive_command.frame(payload))]
        if self._cycle % _STATUS_PERIODS == 0:
            sends.append((send_ns, self._status_frame()))
        if self._cycle % _OBSERVER_PERIODS == _OBSERVER_PHASE:
            sends.append((send_ns, self._observer_frame()))
        self._cycle += 1
        return Actions(next_period(now_ns + 1), tuple(sends))

    def _empty_mailboxes(self) -> None:
        self._mailboxes = mailbox.empty(self._expectations)
        self._rows = dict(zip(self._received_ids, self._mailboxes, strict=True))

    def _restart_task(self) -> None:
        self._task = np.zeros(task.TASK_SIZE, np.int64)
        self._kernel_state = np.zeros(k.ST_SIZE, np.int32)
        self._io = np.zeros(k.IO_SIZE, np.int32)
        self._bench_reset = False
        self._cycle = 0
        try:
            calibration = Calibration.from_bytes(self._calibration_block)
        except CalibrationError:
            self._calibration = np.zeros(k.CAL_SIZE, np.int32)
        else:
            self._calibration = calibration.array()
            self._task[task.IS_CALIBRATED] = 1
            self._task[task.DEFAULT_LAW] = calibration.law
        self._period = partial(
            _period,
            self._mailboxes,
            self._expectations,
            self._layout,
            self._task,
            self._calibration,
            self._kernel_state,
            self._io,
            self._row,
        )

    def _status_frame(self) -> Frame:
        status = self._contract.controller_status
        words = self._task.tolist()
        overruns = int(self._mailboxes[:, mailbox.OVERRUNS].sum())
        flags = {str(fault.name).lower(): int(bool(words[task.FAULTS] & fault)) for fault in task.Fault}
        payload = status.pack(
            state=words[task.STATE],
            control_law=int(self._io[k.IO_LAW]) or words[task.DEFAULT_LAW],
            execution_time=_EXECUTION_TIME_RAW,
            saturations=words[task.SATURATIONS],
            mailbox_overruns=min(overruns, task.COUNT_MAX),
            **flags,
        )
        return status.frame(payload)

    def _observer_frame(self) -> Frame:
        observer = self._contract.observer_state
        page = self._cycle // _OBSERVER_PERIODS % _OBSERVER_PAGES
        value = int(self._kernel_state[k.ST_V1 + page])
        return observer.frame(observer.pack(page, self._cycle & 0xFFFF, value))
