"""The controller node: which of the firmware's entry points runs when. Integers only."""

from functools import partial

import numpy as np

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.packet import NOT_ANSWERED, answer_by_entry_points
from dbc.record import Record
from firmware_py import entry_points
from firmware_py import task_layout as at
from firmware_py.answer import answer_timer
from firmware_py.calibration import flashed
from firmware_py.contract_words import contract_words, received, sent

EXECUTION_NS = 100_000
"""Execution time of a control period between timer and transmit, ns: assumed until it is measured."""

PHASE_NS = 500_000
"""How long after the sensor's sampling instant the controller's timer fires, ns."""


def execution_time(execution_ns: int) -> int:
    """Return an execution time as ControllerStatus has it: a share of the control period, 0.5 %."""
    return -(-execution_ns * 200 // PERIOD_NS)


class Controller:
    """The firmware: mailboxes, state machine, control kernel, transmit.

    Parameters
    ----------
    contract : Contract
        The DBC.
    calibration_block : bytes
        What is flashed; a damaged one keeps the controller in power-on.
    execution_ns : int
        From the timer to transmission.

    Attributes
    ----------
    record : Record
        One row per control period, raw integers.
    """

    name = "controller"

    def __init__(
        self, contract: Contract, calibration_block: bytes, execution_ns: int = EXECUTION_NS
    ) -> None:
        self._execution_ns = execution_ns
        received_ids = [message.can_id for message in received(contract)]
        self.accepts = frozenset({*received_ids, contract.bench_control.can_id})
        self.latched = self.accepts
        self.transmits = frozenset(message.can_id for message in sent(contract))
        self._memory = entry_points.new_memory(contract_words(contract))
        entry_points.flash_calibration(self._memory, flashed(calibration_block))
        self._sends = np.zeros((at.MAX_FRAMES, len(Frame._fields)), np.uint64)
        self._row = np.zeros(len(entry_points.RECORD_COLUMNS), np.int64)
        self._receive = partial(entry_points.receive, self._memory)
        self._period = partial(entry_points.period, self._memory, self._sends, self._row)
        self._answer_timer = partial(answer_timer, self._memory, execution_ns)
        self.record = Record(entry_points.RECORD_COLUMNS, np.int64)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: forget everything, check the calibration."""
        entry_points.power_on(self._memory)
        entry_points.set_execution_time(self._memory, execution_time(self._execution_ns))
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt: latch."""
        self._receive(*frame)
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt: one control period."""
        count = self._period(now_ns)
        self.record.append(self._row)
        send_ns = now_ns + self._execution_ns
        sends = tuple([(send_ns, Frame(*frame)) for frame in self._sends[:count].tolist()])
        return Actions(next_period(now_ns + 1), sends)

    def answer(self, packet: memoryview, answer: bytearray) -> int:
        """Do all that an event asks for in one call; see `dbc.packet`."""
        length: int = self._answer_timer(self.record.rows, self.record.count, packet, answer)
        return answer_by_entry_points(self, packet, answer) if length == NOT_ANSWERED else length
