"""Timing of every control period, from what was on the bus: ages of the inputs, latency, jitter, lateness.

Periods are numbered from the start of the window. Period k lasts from t_k to t_k+1, multiples of the control
period on the time base that all nodes share: the sensor samples at t_k, the controller's timer fires between,
and the drive latches at t_k+1 the newest DriveCommand that has ended by then.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.e2e import MAX_COUNTER
from dbc.node import PERIOD_NS
from firmware_py.node import EXECUTION_NS
from hil.bus.wire_time import INTERMISSION_BITS, traffic_bits
from hil.scenario import TimingLimits
from hil.signals import NothingKnownError

RECORDED = "recorded"
INFERRED = "inferred from the bus"

_FIGURES = {  # attribute of Timing and of TimingLimits: its name in messages
    "feedback_age_us": "feedback age",
    "setpoint_age_us": "setpoint age",
    "latency_us": "latency",
    "jitter_us": "command jitter",
}
_COUNTS = {"missed_periods": "number of missed periods", "late_periods": "number of late periods"}

Evidence = tuple[tuple[Callable[[int], str], np.ndarray], ...]
"""Frames and instants behind the rows of a figure: what names one by its index, and each row's index."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Figure:
    """One figure of every control period; its percentiles raise `NothingKnownError` if there is none.

    Attributes
    ----------
    values : ndarray of float
        The figure, µs; NaN where the frame it counts from never came.
    period : ndarray of int
        Number of the control period that each value belongs to.
    evidence : Evidence
        What the values are made from.
    """

    values: np.ndarray
    period: np.ndarray
    evidence: Evidence

    def __repr__(self) -> str:
        if not self.known.size:
            return f"<{len(self.values)} periods, none measured>"
        return f"<{len(self.values)} periods: p50 {self.p50:.1f}, p99 {self.p99:.1f}, max {self.max:.1f} µs>"

    @property
    def known(self) -> np.ndarray:
        """What could be measured, µs."""
        return self.values[np.isfinite(self.values)]

    @property
    def p50(self) -> float:
        """Median, µs."""
        return self._percentile(50)

    @property
    def p99(self) -> float:
        """99th percentile, µs."""
        return self._percentile(99)

    @property
    def max(self) -> float:
        """Largest value, µs."""
        return self._percentile(100)

    def summary(self) -> dict[str, float | None]:
        """Return median, 99th percentile and maximum, µs; None if nothing was measured."""
        return {name: getattr(self, name) if self.known.size else None for name in ("p50", "p99", "max")}

    def _percentile(self, percent: float) -> float:
        if not self.known.size:
            raise NothingKnownError(f"nothing was measured in {len(self.values)} periods")
        return float(np.percentile(self.known, percent))


@dataclass(frozen=True, slots=True, eq=False)
class Counted:
    """Control periods in which something happened; `len` says how many.

    Attributes
    ----------
    period : ndarray of int
        Their numbers.
    evidence : Evidence
        What shows it.
    """

    period: np.ndarray
    evidence: Evidence

    def __len__(self) -> int:
        return len(self.period)

    @property
    def values(self) -> np.ndarray:
        """How many there were up to each."""
        return np.arange(1, len(self) + 1)


@dataclass(frozen=True, slots=True)
class Violation:
    """A control period that broke a limit; as text, one line.

    Attributes
    ----------
    period : int
        Number of the control period.
    figure : str
        The limit's name in `TimingLimits`.
    value, limit : float
        In µs, NaN for a figure that could not be measured; of missed and late periods, how many there were up
        to this one and how many are allowed.
    evidence : str
        The frames and instants that show it.
    """

    period: int
    figure: str
    value: float
    limit: float
    evidence: str

    @property
    def time_s(self) -> float:
        """Start of the period, counted from the start of the window, s."""
        return self.period * PERIOD_NS / 1e9

    def __str__(self) -> str:
        name, unit = (_FIGURES | _COUNTS)[self.figure], " µs" if self.figure in _FIGURES else ""
        value = "is unknown, limit" if np.isnan(self.value) else f"{round(self.value, 3)}{unit} is above"
        period = f"period {self.period} ({self.time_s:.3f} s)"
        return f"{period}: {name} {value} {self.limit:g}{unit}: {self.evidence}"


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """Timing of all control periods of a window.

    Frames are counted by their id: whether a receiver would have accepted them is not looked at.

    Attributes
    ----------
    feedback_age_us, setpoint_age_us : Figure
        From the end of the newest PositionFeedback (PositionSetpoint) that had ended when the controller's
        timer fired, to that timer; one value per timer.
    latency_us : Figure
        From that feedback's end to the end of the DriveCommand made from it; one value per command.
    jitter_us : Figure
        By how much the interval between two successive ends of DriveCommand differs from one period; one
        value per command, numbered by the period in which it ended.
    missed_periods : Counted
        Periods in which no DriveCommand ended on the bus: at their end the drive found nothing new. As at the
        drive, an end at the very instant of the latch is in time.
    late_periods : Counted
        Periods whose timer's DriveCommand ended after the latch at the period's end.
    longest_gap_us : float
        Longest time without an end of a DriveCommand, the time up to the end of the window included; NaN for
        an empty window.
    periods : int
        Number of periods in the window.
    timer : str
        `RECORDED`, or `INFERRED`: then a delay before the controller's transmission does not show, as the
        timer is taken to have fired as much later.
    """

    feedback_age_us: Figure
    setpoint_age_us: Figure
    latency_us: Figure
    jitter_us: Figure
    missed_periods: Counted
    late_periods: Counted
    longest_gap_us: float
    periods: int
    timer: str

    def summary(self) -> dict[str, Any]:
        """Return the figures as written to ``result.json``."""
        return {
            "timer": self.timer,
            "periods": self.periods,
            **{name: getattr(self, name).summary() for name in _FIGURES},
            **{name: len(getattr(self, name)) for name in _COUNTS},
            "longest_gap_us": _or_none(self.longest_gap_us),
        }

    def violations(self, limits: TimingLimits) -> list[Violation]:
        """Return what broke the limits, in order of periods.

        A period whose figure is unknown breaks its limit, and so does a figure that no period has. Of the
        missed and the late periods, those beyond the allowed number are returned.
        """
        found = []
        for name in (*_FIGURES, *_COUNTS):
            limit, figure = getattr(limits, name), getattr(self, name)
            if limit is None or not self.periods:
                continue
            for row in np.flatnonzero(~(figure.values <= limit)).tolist():
                evidence = ", ".join(text(index[row]) for text, index in figure.evidence)
                period, value = figure.period[row].item(), figure.values[row].item()
                found.append(Violation(period, name, value, limit, evidence))
            if name in _FIGURES and not figure.values.size:
                found.append(Violation(0, name, float("nan"), limit, f"none in all {self.periods} periods"))
        return sorted(found, key=lambda violation: violation.period)


def timing_of(
    traffic: np.ndarray,
    contract: Contract,
    bit_rate: int,
    start_ns: int,
    end_ns: int,
    timer_ns: np.ndarray | None = None,
    execution_ns: int = EXECUTION_NS,
) -> Timing:
    """Return the timing of the control periods in a window.

    Parameters
    ----------
    traffic : ndarray of int, shape (frames, 4)
        Bus time of each frame's end (ns), id, dlc, data, as in `hil.run.options.Recording`.
    contract : Contract
        Names the messages.
    bit_rate : int
        Bit/s, needed to infer the timer.
    start_ns, end_ns : int
        Window in bus time; the whole periods in it count, what lies before and after does not.
    timer_ns : ndarray of int, optional
        Bus times at which the controller's timer fired, in any order. If omitted they are inferred: a
        command's end less its time on the wire and the execution time.
    execution_ns : int
        From the controller's timer to transmission, as assumed or measured.
    """
    feedback = _Frames(traffic, contract.position_feedback)
    setpoint = _Frames(traffic, contract.position_setpoint)
    command = _Frames(traffic, contract.drive_command)
    timer = RECORDED
    if timer_ns is None:
        timer = INFERRED
        timer_ns = command.end_ns - command.duration_ns(bit_rate) - execution_ns
    timers_ns = np.sort(np.asarray(timer_ns, np.int64))
    first = -(-start_ns // PERIOD_NS)
    periods = max(end_ns // PERIOD_NS - first, 0)

    def inside(period: np.ndarray) -> np.ndarray:
        return (period >= 0) & (period < periods)

    period_of_timer = timers_ns // PERIOD_NS - first
    latch_ns = (first + period_of_timer + 1) * PERIOD_NS
    fired = np.flatnonzero(inside(period_of_timer))
    newest_feedback = feedback.newest_at(timers_ns)
    newest_setpoint = setpoint.newest_at(timers_ns)

    timer_of_command = _timer_of_each(command.end_ns, timers_ns, execution_ns)
    known = np.flatnonzero(timer_of_command >= 0)
    made = known[inside(period_of_timer[timer_of_command[known]])]
    made_at = timer_of_command[made]
    answered, first_answer = np.unique(made_at, return_index=True)
    is_late = command.end_ns[made[first_answer]] > latch_ns[answered]
    late_at, late = answered[is_late], made[first_answer][is_late]

    period_of_end = -(-command.end_ns // PERIOD_NS) - 1 - first  # an end at the latch is in time
    ended = np.flatnonzero(inside(period_of_end))
    missed = np.setdiff1d(np.arange(periods), period_of_end[ended])
    missed_latch_ns = (first + missed + 1) * PERIOD_NS
    next_one = ended[ended > 0]
    interval_ns = command.end_ns[next_one] - command.end_ns[next_one - 1]

    timer_text = _named("controller timer", timers_ns)
    return Timing(
        feedback_age_us=Figure(
            feedback.since_us(newest_feedback[fired], timers_ns[fired]),
            period_of_timer[fired],
            ((feedback.text, newest_feedback[fired]), (timer_text, fired)),
        ),
        setpoint_age_us=Figure(
            setpoint.since_us(newest_setpoint[fired], timers_ns[fired]),
            period_of_timer[fired],
            ((setpoint.text, newest_setpoint[fired]), (timer_text, fired)),
        ),
        latency_us=Figure(
            feedback.since_us(newest_feedback[made_at], command.end_ns[made]),
            period_of_timer[made_at],
            ((feedback.text, newest_feedback[made_at]), (timer_text, made_at), (command.text, made)),
        ),
        jitter_us=Figure(
            np.abs(interval_ns - PERIOD_NS) / 1e3,
            period_of_end[next_one],
            ((command.text, next_one - 1), (command.text, next_one)),
        ),
        missed_periods=Counted(
            missed,
            (
                (command.text, command.newest_at(missed_latch_ns)),
                (_named("none from then to the latch", missed_latch_ns), np.arange(len(missed))),
            ),
        ),
        late_periods=Counted(
            period_of_timer[late_at],
            ((timer_text, late_at), (command.text, late), (_named("latch", latch_ns), late_at)),
        ),
        longest_gap_us=_longest_gap_us(command.end_ns, first * PERIOD_NS, periods),
        periods=periods,
        timer=timer,
    )


class _Frames:
    """The frames of one message, in order of their ends."""

    def __init__(self, traffic: np.ndarray, message: MessageCodec[..., Any]) -> None:
        rows = traffic[traffic[:, 1] == message.can_id]
        self._rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self._name = message.name
        self.end_ns = self._rows[:, 0].astype(np.int64)

    def newest_at(self, time_ns: np.ndarray) -> np.ndarray:
        """Return the index of the last frame that had ended at each time, -1 if there was none."""
        return np.searchsorted(self.end_ns, time_ns, side="right") - 1

    def since_us(self, index: np.ndarray, time_ns: np.ndarray) -> np.ndarray:
        """Return the time from the end of each indexed frame to `time_ns`, µs; NaN for index -1."""
        elapsed = np.full(len(index), np.nan)
        known = index >= 0
        elapsed[known] = (time_ns[known] - self.end_ns[index[known]]) / 1e3
        return elapsed

    def duration_ns(self, bit_rate: int) -> np.ndarray:
        """Return each frame's time on the wire from its start to its end, ns."""
        return (traffic_bits(self._rows)[:, 0] - INTERMISSION_BITS) * 1_000_000_000 // bit_rate

    def text(self, index: int) -> str:
        """Return a frame's name, E2E counter and end."""
        if index < 0:
            return f"no {self._name} so far"
        counter = int(self._rows[index, 3]) >> 8 & MAX_COUNTER
        return f"{self._name} (counter {counter}) ended at {_at(self.end_ns[index])}"


def _timer_of_each(command_end_ns: np.ndarray, timers_ns: np.ndarray, execution_ns: int) -> np.ndarray:
    """Return the index of the timer that each command belongs to, -1 if there is none.

    That is the last one an execution time or more before the command's end. If several commands have the same
    one and there are timers without a command before it, the earlier commands were held up and are theirs.
    """
    made_at = np.searchsorted(timers_ns, command_end_ns - execution_ns, side="right") - 1
    taken, begin, group, count = np.unique(
        made_at, return_index=True, return_inverse=True, return_counts=True
    )
    followers = (begin + count)[group] - 1 - np.arange(len(made_at))
    unclaimed = np.diff(taken, prepend=-1)[group] - 1
    return made_at - np.minimum(followers, np.maximum(unclaimed, 0))


def _longest_gap_us(command_end_ns: np.ndarray, begin_ns: int, periods: int) -> float:
    if not periods:
        return float("nan")
    end_ns = begin_ns + periods * PERIOD_NS
    before = command_end_ns[command_end_ns <= begin_ns]
    inside = command_end_ns[(command_end_ns > begin_ns) & (command_end_ns <= end_ns)]
    last_before = before[-1] if before.size else begin_ns
    return float(np.diff([last_before, *inside, end_ns]).max() / 1e3)


def _named(what: str, time_ns: np.ndarray) -> Callable[[int], str]:
    return lambda index: f"{what} at {_at(time_ns[index])}"


def _at(time_ns: int) -> str:
    return f"bus time {time_ns / 1e9:.6f} s"


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
