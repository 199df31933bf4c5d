"""What the acceptance scenarios share: how a scenario is played, and how a reaction is measured."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.diagnosis import State
from hil.bench import Bench
from hil.scenario import PERIOD_S, load_scenario
from hil.signals import Series

FOLDER = Path(__file__).parent
TABLE: dict[str, Any] = tomllib.loads((FOLDER / "requirements.toml").read_text(encoding="utf-8"))

MOTOR_RAMP_RPM_S = 4000.0 * 30.0 / np.pi
MOTOR_LAG_S = 0.040
"""For the motor's first-order lag of 5 ms to fall from 3000 rpm to 1 rpm."""
AT_REST_RPM = 1.0

CRUISE_FROM_M = 0.1
CRUISE_M_S = 0.05
CRUISE_BEGIN_S = 0.5
"""Time by which the start of the move is over."""

_SETTLING_PERIODS = 100
_OVERRUN_AGE_US = 2000.0
_STALE_PERIODS = 3
_STALE_AGE_US = _STALE_PERIODS * 1000.0


class InconclusiveError(Exception):
    """In real time the machine stalled so that the run says nothing about the controller."""


def cruise(time_s: np.ndarray) -> np.ndarray:
    """An even lift, in m."""
    return CRUISE_FROM_M + CRUISE_M_S * time_s


def play(bench: Bench, name: str) -> None:
    """Play a built-in scenario in full."""
    scenario = load_scenario(name)
    bench.setpoint(scenario.position_m)
    for time_s, force_n in scenario.load:
        bench.run(time_s - bench.time_s)
        bench.load_force(force_n)
    bench.run(scenario.duration_s - bench.time_s)


def hold_here(bench: Bench) -> None:
    """Take the present position for the setpoint."""
    bench.setpoint(bench.position_mm.last * 1e-3)


def faults(bench: Bench) -> set[str]:
    """Names of the controller's faults; without overruns in real time, where a stall makes some."""
    return bench.controller_faults - ({"MailboxOverrun"} if bench.mode == "realtime" else set())


def undisturbed(bench: Bench, series: Series) -> Series:
    """Return a series by control period without the 100 ms after a period that the machine overran.

    In virtual time there are none. An input that is one period late is no overrun: it moves the rod by 50 µm
    at most at the speeds played here. If less than half of the periods are left, the run says nothing.
    """
    timing = bench.timing
    overrun = {*timing.missed_periods.period.tolist(), *timing.late_periods.period.tolist()}
    for age in (timing.feedback_age_us, timing.setpoint_age_us):
        overrun |= set(age.period[~(age.values < _OVERRUN_AGE_US)].tolist())
    period = np.rint(series.time_s / PERIOD_S)
    keep = np.ones(len(series), bool)
    for number in overrun:
        keep &= (period < number) | (period >= number + _SETTLING_PERIODS)
    if keep.sum() < len(series) / 2:
        raise InconclusiveError(f"periods {sorted(overrun)} were overrun")
    return Series(series.time_s[keep], series.values[keep])


def stall(bench: Bench) -> str:
    """Say which stall of the machine justifies that a side stopped in real time, or nothing."""
    timing = bench.timing
    for name, age in (("feedback", timing.feedback_age_us), ("setpoint", timing.setpoint_age_us)):
        if age.known.size and age.max >= _STALE_AGE_US:
            return f"the {name} was {age.max / 1e3:.1f} periods old"
    if len(timing.missed_periods) >= _STALE_PERIODS:
        return f"the commands of {len(timing.missed_periods)} periods were missed"
    return ""


def state_changes(bench: Bench) -> list[State]:
    """Return the states the controller was in since time 0, one after the other."""
    states = bench.trace["controller_state"]
    states = states[np.isfinite(states)]
    return [State(int(s)) for s in states[np.flatnonzero(np.diff(states, prepend=-1))]]


@dataclass(frozen=True)
class Reaction:
    """What a moving machine did after something went wrong."""

    safe_s: float
    """Until the controller was in its safe state; NaN if it never was."""
    at_rest_s: float
    """Until the motor was at rest for good."""
    ramp_s: float
    """How long the drive's ramp takes from the speed that the motor had."""


def reaction(bench: Bench, since_s: float) -> Reaction:
    """Measure what happened since a time."""
    states = Series(bench.trace["time_s"], bench.trace["controller_state"]).between(since_s)
    speed = bench.motor_speed_rpm.between(since_s)
    moving = np.flatnonzero(~(np.abs(speed.values) < AT_REST_RPM))
    assert moving.size, "the motor was at rest before"
    assert moving[-1] < len(speed) - 1, "the motor is still moving"
    ramp_s = abs(speed.values[0]) / MOTOR_RAMP_RPM_S
    return Reaction(
        states.first(State.SAFE) - since_s, float(speed.time_s[moving[-1] + 1]) - since_s, float(ramp_s)
    )
