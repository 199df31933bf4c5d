"""Replay: what the firmware would have sent on recorded traffic, beside what was sent, bit by bit.

Every frame of the log that the controller accepts reaches a new one at its recorded time, from the first
reset on: what came before is not known, and a reset forgets it. Timer interrupts come at the controller's
phase of the control period; a frame that ends at the instant of the timer was there before it, as on our
wire.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.frame import ERR_FLAG, Frame
from dbc.messages import BenchCommand
from dbc.node import PERIOD_NS
from dbc.profile2 import MAX_COUNTER
from firmware_py.calibration import Calibration
from firmware_py.chosen_firmware import ChosenFirmware
from firmware_py.node import PHASE_NS, Controller
from hil.bus.wire import Clock
from hil.bus.wire_time import INTERMISSION_BITS, traffic_bits
from hil.bus_log import RESOLUTION_NS
from hil.run.options import BenchError

WAITING_FRAMES = 1000
"""How many frames of a message may be under way, as on a bus that somebody else blocks."""

OPEN_NS = 10 * PERIOD_NS
"""Frames handed over less than this before the log's end may have come after it."""

_PROGRESS_FRAMES = 1000
_LEAST_IN_PHASE = 0.9


@dataclass(frozen=True, slots=True)
class TimerPhase:
    """When the timer of the recorded controller fired in its control period, in the times of a log.

    Attributes
    ----------
    phase_ns : int
        From a multiple of the control period on, 0 to `PERIOD_NS` - 1.
    exact : bool
        Whether the log's times are those of a simulated bus, whose clocks are known; otherwise the phase is
        inferred from the earliest commands, and in real time the timer may have fired later than that.
    """

    phase_ns: int
    exact: bool


@dataclass(frozen=True, slots=True)
class Difference:
    """A frame that is not the same in the log and in the replay.

    Attributes
    ----------
    time_ns : int
        End of the recorded frame, or hand-over of one that is not recorded, in the times of the log.
    message : str
        Its name in the DBC.
    recorded, computed : Frame or None
        None where there is no such frame.
    """

    time_ns: int
    message: str
    recorded: Frame | None
    computed: Frame | None


@dataclass(frozen=True, slots=True, eq=False)
class MessageReplay:
    """The frames of one message in the log and in the replay, and which belong together.

    Attributes
    ----------
    name : str
        Of the message.
    recorded, computed : ndarray of uint64, shape (frames, 4)
        As `hil.run.options.Recording.traffic`, but the computed at their hand-over.
    partner : ndarray of int
        Of each recorded frame the computed one, -1 if there is none.
    lost : ndarray of int
        Computed frames that never ended on the recorded bus: the E2E counter of the recorded ones tells.
    missing : ndarray of int
        Computed frames that are not in the log, without such a proof.
    """

    name: str
    recorded: np.ndarray
    computed: np.ndarray
    partner: np.ndarray
    lost: np.ndarray
    missing: np.ndarray

    @property
    def is_equal(self) -> np.ndarray:
        """Of each recorded frame, whether the computed one has the same length and bits."""
        same = (self.computed[self.partner, 2:] == self.recorded[:, 2:]).all(axis=1)
        equal: np.ndarray = same & (self.partner >= 0)
        return equal

    @property
    def differences(self) -> list[Difference]:
        """All of them, in order of time."""
        found = []
        for row in np.flatnonzero(~self.is_equal).tolist():
            computed = None if self.partner[row] < 0 else _frame(self.computed[self.partner[row]])
            recorded = _frame(self.recorded[row])
            found.append(Difference(int(self.recorded[row, 0]), self.name, recorded, computed))
        for row in self.missing.tolist():
            found.append(Difference(int(self.computed[row, 0]), self.name, None, _frame(self.computed[row])))
        return sorted(found, key=lambda difference: difference.time_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What came of a replay.

    Attributes
    ----------
    begin_ns : int
        The first reset in the log.
    phase : TimerPhase
        The timer's.
    messages : tuple of MessageReplay
        Of each message that the controller sends.
    timers_ns : ndarray of int
        The timer interrupts.
    unsure_ns : ndarray of int
        Timer interrupts so close to a frame's end that the log cannot tell which came first.
    error_frames : int
        Error frames that were passed over.
    """

    begin_ns: int
    phase: TimerPhase
    messages: tuple[MessageReplay, ...]
    timers_ns: np.ndarray
    unsure_ns: np.ndarray
    error_frames: int

    @property
    def differences(self) -> list[Difference]:
        """Those of all messages, in order of time."""
        found = [difference for message in self.messages for difference in message.differences]
        return sorted(found, key=lambda difference: difference.time_ns)

    @property
    def compared_periods(self) -> int:
        """Control periods of which at least one frame is in the log."""
        return len(self._periods(lambda message: message.partner >= 0))

    @property
    def equal_periods(self) -> int:
        """Control periods whose frames in the log are all as computed."""
        unequal = self._periods(lambda message: (message.partner >= 0) & ~message.is_equal)
        return self.compared_periods - len(unequal)

    def _periods(self, chosen: Callable[[MessageReplay], np.ndarray]) -> np.ndarray:
        handed_over = [message.computed[message.partner[chosen(message)], 0] for message in self.messages]
        return np.unique(np.concatenate(handed_over))


def replay(
    traffic: np.ndarray,
    contract: Contract,
    calibration: Calibration,
    bit_rate: int,
    law: int | None = None,
    firmware: ChosenFirmware | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Replay:
    """Feed a recorded bus to a new controller and compare what it sends with what is recorded.

    Parameters
    ----------
    traffic : ndarray of uint64, shape (frames, 4)
        As `hil.bus_log.BusLog.traffic`.
    contract : Contract
        The DBC.
    calibration : Calibration
        What the controller is flashed with.
    bit_rate : int
        Bit/s of the recorded bus; it matters only where the timer's phase has to be inferred.
    law : int, optional
        Control law that takes the place of the recorded one in every intact ControllerCommand.
    firmware : ChosenFirmware, optional
        What runs the controller, and how long a control period takes on it; Python if not given.
    progress : callable
        Told the share of the log that is done.

    Raises
    ------
    BenchError
        If the log has no reset, no command after it, or if the commands keep no phase.
    """
    is_error = traffic[:, 1] & np.uint64(ERR_FLAG) != 0
    data_frames = traffic[~is_error]
    firmware = firmware or ChosenFirmware()
    controller = firmware.controller(contract, calibration.to_bytes())
    resets = _resets_in(data_frames, contract)
    if not resets.size:
        raise BenchError(
            "there is no BenchControl reset in the log, so that the state in which the firmware was is not "
            "known: begin the log before the run"
        )
    heard = data_frames[resets[0] :]
    commands = heard[heard[:, 1] == contract.drive_command.can_id]
    if not len(commands):
        raise BenchError("there is no DriveCommand after the reset in the log: nothing to compare with")
    phase = _phase_of(heard[resets - resets[0], 0], commands, bit_rate, firmware.execution_ns)
    inputs = heard[np.isin(heard[:, 1], list(controller.accepts))]
    if law is not None:
        inputs = _under_law(inputs, contract, law)
    timers_ns, computed = _run(controller, inputs, phase.phase_ns, int(heard[-1, 0]), progress)
    messages = tuple(
        _compared(contract.message(name), heard, computed)
        for name in ("DriveCommand", "ControllerStatus", "ObserverState")
    )
    return Replay(
        begin_ns=int(heard[0, 0]),
        phase=phase,
        messages=messages,
        timers_ns=timers_ns,
        unsure_ns=_unsure(timers_ns, inputs, bit_rate, phase),
        error_frames=int(is_error.sum()),
    )


def _frame(row: np.ndarray) -> Frame:
    return Frame(*row[1:].tolist())


def _resets_in(frames: np.ndarray, contract: Contract) -> np.ndarray:
    """Return the indices of the frames that reset the controller."""
    control = contract.bench_control
    found = np.flatnonzero(frames[:, 1] == control.can_id)
    return np.array(
        [i for i in found if control.unpack(int(frames[i, 3])).command == BenchCommand.RESET], int
    )


def _phase_of(resets_ns: np.ndarray, commands: np.ndarray, bit_rate: int, execution_ns: int) -> TimerPhase:
    """Return the timer's phase: known where resets come at whole periods, as on a simulated bus."""
    offset_ns = (resets_ns.astype(np.int64) + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2
    if (np.abs(offset_ns) <= RESOLUTION_NS).all():
        return TimerPhase(PHASE_NS, exact=True)
    offset_ns = np.sort(_latest_timer_ns(commands, bit_rate, execution_ns) % PERIOD_NS)
    twice = np.concatenate([offset_ns, offset_ns + PERIOD_NS])
    followers = np.searchsorted(twice, offset_ns + PERIOD_NS // 2) - np.arange(len(offset_ns))
    best = int(followers.argmax())
    if followers[best] < _LEAST_IN_PHASE * len(offset_ns):
        raise BenchError(
            "the commands in the log keep no phase (a clock that drifts, stalls, another --bitrate): which "
            "frames a control period used cannot be told"
        )
    return TimerPhase(int(offset_ns[best]), exact=False)


def _latest_timer_ns(commands: np.ndarray, bit_rate: int, execution_ns: int) -> np.ndarray:
    """Return when the timer behind each command fired at the latest: it met an idle bus then."""
    wire_ns = (traffic_bits(commands)[:, 0] - INTERMISSION_BITS) * 1_000_000_000 // bit_rate
    latest_ns: np.ndarray = commands[:, 0].astype(np.int64) - wire_ns - execution_ns
    return latest_ns


def _unsure(timers_ns: np.ndarray, inputs: np.ndarray, bit_rate: int, phase: TimerPhase) -> np.ndarray:
    """Return the timers before or after which a frame ended by less than the log can tell."""
    if phase.exact and 1_000_000_000 % (bit_rate * RESOLUTION_NS) == 0:
        return timers_ns[:0]  # frames end, and timers fire, at times that the log has exactly
    ends_ns = inputs[:, 0].astype(np.int64)
    near = np.searchsorted(ends_ns, timers_ns + RESOLUTION_NS, "right") > np.searchsorted(
        ends_ns, timers_ns - RESOLUTION_NS, "left"
    )
    unsure: np.ndarray = timers_ns[near]
    return unsure


def _under_law(inputs: np.ndarray, contract: Contract, law: int) -> np.ndarray:
    """Return the frames with another control law in every ControllerCommand whose CRC is right."""
    command = contract.controller_command
    changed = inputs.copy()
    for row in np.flatnonzero((inputs[:, 1] == command.can_id) & (inputs[:, 2] == command.dlc)).tolist():
        data = int(inputs[row, 3])
        if command.with_crc(data) == data:
            asked = command.unpack(data)
            payload = command.pack(asked.enable, law, asked.fault_reset)
            changed[row, 3] = command.with_crc(payload | data & MAX_COUNTER << 8)
    return changed


def _run(
    controller: Controller,
    inputs: np.ndarray,
    phase_ns: int,
    end_ns: int,
    progress: Callable[[float], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants of the timer up to `end_ns`, and what the controller handed over."""
    clock = Clock(phase_ns)
    timers_ns: list[int] = []
    sent: list[tuple[int, int, int, int]] = []

    local_wake_ns, _ = controller.on_start(clock.local(int(inputs[0, 0])))
    assert local_wake_ns is not None
    wake_ns = clock.bus(local_wake_ns)

    def run_timer(until_ns: int) -> None:
        nonlocal wake_ns
        while wake_ns < until_ns:
            timers_ns.append(wake_ns)
            local_wake_ns, sends = controller.on_timer(clock.local(wake_ns))
            assert local_wake_ns is not None
            sent.extend((clock.bus(send_ns), *frame) for send_ns, frame in sends)
            wake_ns = clock.bus(local_wake_ns)

    for row, (time_ns, can_id, dlc, data) in enumerate(inputs.tolist()):
        run_timer(time_ns)
        controller.on_frame(clock.local(time_ns), Frame(can_id, dlc, data))
        if row % _PROGRESS_FRAMES == 0:
            progress(row / len(inputs))
    run_timer(end_ns + 1)
    return np.array(timers_ns, np.int64), np.array(sent, np.uint64).reshape(-1, 4)


def _compared(message: MessageCodec[..., Any], heard: np.ndarray, computed: np.ndarray) -> MessageReplay:
    """Find the computed frame of each recorded one of a message."""
    ours = computed[computed[:, 1] == message.can_id]
    recorded = heard[heard[:, 1] == message.can_id]
    if len(ours):
        recorded = recorded[recorded[:, 0] > ours[0, 0]]  # what came before was handed over before the reset
    partner = np.fromiter(_partners(recorded.tolist(), ours.tolist()), int, len(recorded))
    alone = np.setdiff1d(np.arange(len(ours)), partner)
    alone = alone[ours[alone, 0].astype(np.int64) < int(heard[-1, 0]) - OPEN_NS]
    is_lost = np.zeros(len(alone), bool)
    if message.data_ids is not None:
        paired = partner >= 0
        equal = (ours[partner, 2:] == recorded[:, 2:]).all(axis=1) & paired
        is_lost = alone < partner[equal].max(initial=-1)
    return MessageReplay(message.name, recorded, ours, partner, alone[is_lost], alone[~is_lost])


def _partners(recorded: list[list[int]], computed: list[list[int]]) -> Iterator[int]:
    """Yield the index of the computed frame of each recorded one, -1 if there is none.

    Of those that had been handed over by its end and have no partner yet, it is the newest with the same
    bits, since frames may be held up or lost; if none has them, it is the newest of all.
    """
    waiting: deque[int] = deque(maxlen=WAITING_FRAMES)
    handed_over = 0
    for end_ns, _, *content in recorded:
        while handed_over < len(computed) and computed[handed_over][0] < end_ns:
            waiting.append(handed_over)
            handed_over += 1
        partner = next((row for row in reversed(waiting) if computed[row][2:] == content), None)
        if partner is None:
            partner = waiting[-1] if waiting else -1
        if partner >= 0:
            waiting.remove(partner)
        yield partner
