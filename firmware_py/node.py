"""The controller node: what its timer and receive interrupts do. Integers only."""

from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.frame import Frame
from dbc.jit import entry_point
from dbc.messages import BenchCommand
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.packet import HEAD_DLC, NOT_ANSWERED, answer_by_entry_points, append_frame, event_ns
from dbc.record import Record
from firmware_py import mailbox, task
from firmware_py.answer import answer_timer
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
_answer_timer = entry_point(answer_timer)


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
        self._expectations = np.array([mailbox.expectation(*entry) for entry in received.items()])
        self._mailboxes = mailbox.empty(self._expectations)
        received_ids = [message.can_id for message in received]
        self._rows = dict(zip(received_ids, self._mailboxes, strict=True))
        self.accepts = frozenset({*received_ids, contract.bench_control.can_id})
        self.latched = self.accepts
        self.transmits = frozenset(
            message.can_id
            for message in (contract.drive_command, contract.controller_status, contract.observer_state)
        )
        self._task = np.zeros(task.TASK_SIZE, np.int64)
        self._kernel_state = np.zeros(k.ST_SIZE, np.int32)
        self._io = np.zeros(k.IO_SIZE, np.int32)
        self._calibration = np.zeros(k.CAL_SIZE, np.int32)
        self._row = np.zeros(len(task.RECORD_COLUMNS), np.int64)
        arrays = (
            self._mailboxes,
            self._expectations,
            contract.drive_command.protected_layout(),
            self._task,
            self._calibration,
            self._kernel_state,
            self._io,
        )
        self._period = partial(_period, *arrays, self._row)
        ids = np.array(received_ids)
        command_head = contract.drive_command.can_id | contract.drive_command.dlc << HEAD_DLC
        self._answer_timer = partial(_answer_timer, ids, command_head, EXECUTION_NS, *arrays)
        self.record = Record(task.RECORD_COLUMNS, np.int64)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: forget everything, check the calibration."""
        self._restart()
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt: latch. A reset forgets what came before it, not what comes after."""
        row = self._rows.get(frame.can_id)
        if row is not None:
            _receive(row, frame.data, frame.dlc)
        elif self._contract.bench_control.unpack(frame.data).command == BenchCommand.RESET:
            self._restart()
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt: one control period."""
        payload = self._period(now_ns)
        self.record.append(self._row)
        send_ns = now_ns + EXECUTION_NS
        frames = [self._drive_command.frame(payload), *self._other_frames()]
        return Actions(next_period(now_ns + 1), tuple((send_ns, frame) for frame in frames))

    def answer(self, packet: memoryview, answer: bytearray) -> int:
        """Do all that an event asks for in one call; see `dbc.packet`."""
        length: int = self._answer_timer(self.record.rows, self.record.count, packet, answer)
        if length == NOT_ANSWERED:
            return answer_by_entry_points(self, packet, answer)
        for frame in self._other_frames():
            length = append_frame(answer, length, event_ns(packet) + EXECUTION_NS, frame)
        return length

    def _other_frames(self) -> list[Frame]:
        """Return what is sent beside DriveCommand in this period."""
        frames = []
        if self._cycle % _STATUS_PERIODS == 0:
            frames.append(self._status_frame())
        if self._cycle % _OBSERVER_PERIODS == _OBSERVER_PHASE:
            frames.append(self._observer_frame())
        self._cycle += 1
        return frames

    def _restart(self) -> None:
        self._mailboxes[:] = mailbox.empty(self._expectations)
        for words in (self._task, self._kernel_state, self._io, self._calibration):
            words[:] = 0
        self._cycle = 0
        with suppress(CalibrationError):
            calibration = Calibration.from_bytes(self._calibration_block)
            self._calibration[:] = calibration.array()
            self._task[task.IS_CALIBRATED] = 1
            self._task[task.DEFAULT_LAW] = calibration.law

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
