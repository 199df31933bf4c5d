"""The supervisor node: brings the machine up, then sends setpoints and mode commands as it is steered."""

from collections.abc import Callable
from functools import partial
from heapq import heappop, heappush
from itertools import count
from typing import Any

import numpy as np

from dbc import e2e
from dbc.contract import Contract
from dbc.frame import Frame
from dbc.jit import entry_point
from dbc.messages import BenchCommand
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.packet import HEAD_DLC, NOT_ANSWERED, answer_by_entry_points
from dbc.profile2 import CONFIGURATION_SIZE
from dbc.record import Record
from hil.references import setpoint_counts
from hil.scenario import CONTROLLERS, PERIOD_S, Scenario, law_of
from hil.setpoints import answer_setpoint

BRING_UP_PERIODS = 100
"""Periods from the supervisor's start to the first one of a scenario: the drive is enabled in them."""

BRING_UP_S = BRING_UP_PERIODS * PERIOD_NS * 1e-9

Reference = Callable[[np.ndarray], np.ndarray]
"""Position in m over an array of times in s, from the period at which it begins."""

_ARMING_PERIODS = (1, 2, 5, 9, 13)
"""When commands without Enable are sent: the first starts the receiver's counter, the second arms.

The others, like the repeated Enable, are for real time, where a side that stalls misses or overwrites some.
"""

_ENABLE_PERIODS = (20, 24, 28, 32)

_COMMAND_PERIODS = 100
_CHUNK = 1000
_protect, _answer_setpoint = entry_point(e2e.profile2_protect), entry_point(answer_setpoint)


class Supervisor:
    """Sends a setpoint every period, and mode commands and loads when they change.

    It may be steered while it runs: what is asked for takes effect with the next period, or with a later
    one that is named. Steering from another thread is safe.

    Parameters
    ----------
    contract : Contract
        The DBC.
    controller : str
        One of `CONTROLLERS`.
    position_m : float
        Initial position of the machine, held until there is a reference.

    Attributes
    ----------
    record : Record
        One row per period.
    start_ns : int
        Bus time of the scenario's first period.
    next_period : int
        Number of the next period since power-on.
    silent : set of int
        Ids of own messages that are held back.
    bench_frames : list of Frame
        What it has sent on the bench channel.
    """

    name = "supervisor"
    accepts: frozenset[int] = frozenset()
    latched: frozenset[int] = frozenset()

    def __init__(self, contract: Contract, controller: str, position_m: float = 0.0) -> None:
        if controller not in CONTROLLERS:
            raise ValueError(f"there is no controller {controller!r}: choose one of {', '.join(CONTROLLERS)}")
        self.record = Record(("time_ns", "reference_m", "setpoint_raw", "load_n"), np.float64)
        self.start_ns = 0
        self.next_period = 0
        self.silent: set[int] = set()
        self.bench_frames: list[Frame] = []
        self._setpoint = contract.position_setpoint
        self._command = contract.controller_command
        self._bench_control = contract.bench_control
        self._bench_load = contract.bench_load
        self._bench_channel_ids = contract.bench_channel_ids
        counter, layout = np.zeros(1, np.int64), self._setpoint.protected_layout()
        self._protect_setpoint = partial(_protect, counter, layout[:CONFIGURATION_SIZE])
        setpoint_head = self._setpoint.can_id | self._setpoint.dlc << HEAD_DLC
        self._answer_setpoint = partial(_answer_setpoint, setpoint_head, layout, counter)
        self._protect_command = self._command.protector().protect
        self.transmits = frozenset({self._setpoint.can_id, self._command.can_id})
        self._origin_ns = 0
        self._initial_counts = int(setpoint_counts(np.array(position_m)))
        self._reference: Reference = partial(np.full_like, fill_value=position_m)
        self._reference_begin = 0
        self._chunk = np.zeros(0), np.zeros(0, np.int64)
        self._chunk_begin = 0
        self._plain_until = 0  # the first period in which there is certainly more to do than a setpoint
        self._words = {"enable": 0, "law": law_of(controller), "fault_reset": 0, "load_n": 0}
        self._added_load_n = 0
        self._load_n = 0
        self._plan: list[tuple[int, int, dict[str, Any]]] = []
        self._planned = count()
        for enable, periods in ((0, _ARMING_PERIODS), (1, _ENABLE_PERIODS)):
            for period in periods:
                self.plan(period, enable=enable)

    def plan(self, period: int, **words: Any) -> None:
        """Change something in a period that is to come.

        Parameters
        ----------
        period : int
            Since power-on; one that is over means the next.
        **words
            `enable`, `fault_reset`, `load_n` and `add_load_n` (int; forces on top of `load_n` add up),
            `reference` (`Reference`), or `control` (command, identifier and value of a BenchControl).
        """
        heappush(self._plan, (period, next(self._planned), words))

    def plan_scenario(self, scenario: Scenario) -> None:
        """Plan a scenario's reference and loads, from the end of the bring-up on."""
        self.plan(BRING_UP_PERIODS, reference=scenario.position_m)
        for period, force_n in scenario.load_changes:
            self.plan(BRING_UP_PERIODS + period, load_n=force_n)

    def steer(self, **words: Any) -> None:
        """Change something with the next period; see `plan`."""
        self.plan(self.next_period, **words)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: the machine is put to its initial state with the first period."""
        self._origin_ns = next_period(now_ns)
        self.next_period = self._plain_until = 0
        self.start_ns = self._origin_ns + BRING_UP_PERIODS * PERIOD_NS
        return Actions(self._origin_ns)

    def on_timer(self, now_ns: int) -> Actions:
        """Send this period's setpoint, and what else is due."""
        period = (now_ns - self._origin_ns) // PERIOD_NS
        frames = self._frames_of_change(period)
        reference_m, raw = self._position_in(period)
        sends: tuple[tuple[int, Frame], ...] = ()
        if self._setpoint.can_id not in self.silent:
            payload: int = self._protect_setpoint(self._setpoint.pack(raw))
            sends = ((now_ns, self._setpoint.frame(payload)),)
        if frames:
            sends += tuple((now_ns, frame) for frame in frames)
        self.record.append((now_ns, reference_m, raw, self._load_n))
        self.next_period = period + 1
        next_command = (period // _COMMAND_PERIODS + 1) * _COMMAND_PERIODS
        self._plain_until = min(next_command, self._chunk_begin + _CHUNK)
        return Actions(self._origin_ns + (period + 1) * PERIOD_NS, sends)

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Hear nothing: the acceptance filter is empty."""
        return NOTHING

    def answer(self, packet: memoryview, answer: bytearray) -> int:
        """Do all that an event asks for in one call; see `dbc.packet`."""
        period, length = self.next_period, NOT_ANSWERED
        is_planned = self._plan and self._plan[0][0] <= period
        if period < self._plain_until and not is_planned and not self.silent:
            length = self._answer_setpoint(
                *self._chunk,
                period - self._chunk_begin,
                self._origin_ns + period * PERIOD_NS,
                self._load_n,
                self.record.rows,
                self.record.count,
                packet,
                answer,
            )
        if length == NOT_ANSWERED:
            return answer_by_entry_points(self, packet, answer)
        self.next_period = period + 1
        return length

    def _frames_of_change(self, period: int) -> list[Frame]:
        """Return the frames beside the setpoint, in the order in which they are sent."""
        is_first = self.next_period == 0  # it may come late, and then is not period 0
        commanded = not is_first and period // _COMMAND_PERIODS > (self.next_period - 1) // _COMMAND_PERIODS
        if not (is_first or commanded or (self._plan and self._plan[0][0] <= period)):
            return []
        frames = [self._control_frame(BenchCommand.RESET, 0, self._initial_counts)] if is_first else []
        loaded = is_first
        while self._plan and self._plan[0][0] <= period:
            _, _, words = heappop(self._plan)
            if control := words.pop("control", None):
                frames.append(self._control_frame(*control))
            if reference := words.pop("reference", None):
                self._reference, self._reference_begin = reference, period
                self._chunk, self._chunk_begin = (np.zeros(0), np.zeros(0, np.int64)), period
            loaded |= bool(words.keys() & {"load_n", "add_load_n"})
            self._added_load_n += words.pop("add_load_n", 0)
            commanded |= bool(words.keys() & {"enable", "fault_reset"})
            self._words |= words
        self._load_n = self._words["load_n"] + self._added_load_n
        if commanded and self._command.can_id not in self.silent:
            frames.append(self._command_frame())
        if loaded:
            frames.append(self._bench_load.frame(self._bench_load.pack(self._load_n)))
        self.bench_frames += [frame for frame in frames if frame.can_id in self._bench_channel_ids]
        return frames

    def _position_in(self, period: int) -> tuple[float, int]:
        """Return the reference of a period, in m and in counts of the setpoint."""
        index = period - self._chunk_begin
        if index >= len(self._chunk[0]):
            self._chunk_begin, index = period, 0
            elapsed = np.arange(period, period + _CHUNK) - self._reference_begin
            time_s = elapsed * PERIOD_S
            reference_m = np.broadcast_to(np.asarray(self._reference(time_s), float), time_s.shape)
            self._chunk = reference_m.copy(), setpoint_counts(reference_m).astype(np.int64)
        return float(self._chunk[0][index]), int(self._chunk[1][index])

    def _command_frame(self) -> Frame:
        message, words = self._command, self._words
        payload = message.pack(words["enable"], words["law"], words["fault_reset"])
        return message.frame(self._protect_command(payload))

    def _control_frame(self, command: int, identifier: int, value: int) -> Frame:
        message = self._bench_control
        return message.frame(message.pack(command, identifier, value))
