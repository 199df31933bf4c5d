"""Playing the cases of the fault matrix, measuring what comes of them, and judging it."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dbc.codec import signal_name
from dbc.frame import ERR_FLAG
from firmware_py.chosen_tuning import ChosenTuning
from firmware_py.diagnosis import Fault as ControllerFault
from firmware_py.diagnosis import State
from firmware_py.node import PHASE_NS
from hil.bench import Bench
from hil.faults.catalogue import GROUPS
from hil.faults.names import NODES
from hil.measure import M_TO_MM
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions
from hil.scenario import PERIOD_S
from hil.study.fault_matrix import ABOUT, AT_REST_RPM, PHASES, Case, Detector, Phase, Reaction
from plant_sim.drive import State as Drive

BEFORE_S = 0.5
"""From the start of a phase to the fault."""
AFTER_S = 0.8
"""From the fault to the end."""

_WATCHED_S = 0.01
_CONTROLLER_PHASE_MS = PHASE_NS * 1e-6
_CASES_PER_TASK = 40
_MS = 1e3 * PERIOD_S
_END_STATES = {
    Reaction.SAFE: ("safe",),
    Reaction.DRIVE_STOP: ("safe", "off"),
    Reaction.STANDBY: ("standby",),
}
_DRIVE_STOPPING = (Drive.FAULT_REACTION_ACTIVE, Drive.FAULT)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was measured, times in ms since the fault.

    Attributes
    ----------
    by : Detector
        Who noticed first.
    detected_ms : float or None
        When.
    signals : tuple of str
        Fault signals of ControllerStatus that got set.
    state : str
        Of the controller in the end.
    drive : str
        State of the drive in the end.
    stayed : bool
        Whether the controller stayed in the state of the phase.
    at_rest_ms : float or None
        When the motor came to rest for good; None if it turned to the end.
    speed_rpm : float
        Highest speed of the motor from the fault on.
    error_mm : float
        Largest deviation of the rod itself from its reference.
    effect_mm, end_effect_mm : float
        Its deviation from where it would have been without the fault: the largest, and that in the end.
    bus_differs : bool
        Whether anything on the bus, the bench channel left out, went otherwise than without the fault.
    """

    by: Detector
    detected_ms: float | None
    signals: tuple[str, ...]
    state: str
    drive: str
    stayed: bool
    at_rest_ms: float | None
    speed_rpm: float
    error_mm: float
    effect_mm: float
    end_effect_mm: float
    bus_differs: bool


@dataclass(frozen=True, slots=True)
class Played:
    """A case that was played.

    Attributes
    ----------
    case : Case
    outcome : Outcome
    allowed_stop_ms : float
        The fault-tolerant time at the speed that the motor had.
    complaints : tuple of str
        What is not as expected.
    course : dict of ndarray
        Some columns of the trace, time counting from the fault; empty unless the case is to be drawn.
    """

    case: Case
    outcome: Outcome
    allowed_stop_ms: float
    complaints: tuple[str, ...]
    course: dict[str, np.ndarray]

    def table(self) -> dict[str, Any]:
        """Return it as written to ``matrix.json``."""
        return {
            "fault": self.case.name,
            "kind": self.case.fault.kind,
            "group": next(name for name, kinds in GROUPS.items() if type(self.case.fault) in kinds),
            "phase": self.case.phase,
            "expected": asdict(self.case.expected),
            "measured": asdict(self.outcome),
            "allowed_stop_ms": self.allowed_stop_ms,
            "as_expected": not self.complaints,
            "complaints": list(self.complaints),
        }


def play_matrix(
    cases: Sequence[Case],
    tuning: ChosenTuning,
    executor: Executor,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Played]:
    """Play and judge cases, each in a session of its own.

    Parameters
    ----------
    cases : sequence of Case
    tuning : ChosenTuning
    executor : Executor
        From `hil.study.runs.all_cores`; the number of its workers has no part in the result.
    progress : callable
        Told how many cases are done; what it raises ends the runs.
    """
    played: list[Played] = []
    tasks = [cases[begin : begin + _CASES_PER_TASK] for begin in range(0, len(cases), _CASES_PER_TASK)]
    for part in executor.map(partial(_play_some, tuning), tasks):
        played += part
        progress(len(played))
    return played


def matrix_of(played: Sequence[Played], tuning: ChosenTuning) -> dict[str, Any]:
    """Return what was played as written to ``matrix.json``."""
    return {
        "tuning": tuning.name,
        "before_s": BEFORE_S,
        "after_s": AFTER_S,
        "cases": [one.table() for one in played],
    }


def play_case(rig: InprocessRig, case: Case, baseline: Bench) -> Played:
    """Play a case and judge it against what is expected and against a run without the fault."""
    bench = _begin(rig, PHASES[case.phase])
    bench.inject(case.fault)
    bus_off_ms = _watch(bench)
    bench.run(AFTER_S - _WATCHED_S)
    outcome = _measured(bench, baseline, bus_off_ms, case)
    allowed_ms = case.expected.allowed_stop_ms(outcome.speed_rpm)
    complaints = tuple(_complaints(case, outcome, allowed_ms))
    return Played(case, outcome, allowed_ms, complaints, _course(bench) if case.is_drawn else {})


def _play_some(tuning: ChosenTuning, cases: Sequence[Case]) -> list[Played]:
    with InprocessRig(RigOptions(record_directory=Path(), tuning=tuning)) as rig:
        baselines: dict[str, Bench] = {}
        for name in dict.fromkeys(case.phase for case in cases):
            baselines[name] = _begin(rig, PHASES[name])
            baselines[name].run(AFTER_S)
        return [play_case(rig, case, baselines[case.phase]) for case in cases]


def _begin(rig: InprocessRig, phase: Phase) -> Bench:
    bench = Bench(rig, position_m=float(phase.reference_m(np.zeros(1))[0]))
    if not phase.is_enabled:
        bench.disable()
    bench.setpoint(phase.reference_m)
    bench.run(BEFORE_S)
    return bench


def _watch(bench: Bench) -> float | None:
    """Run the first periods after the fault one by one; return when a node was seen bus-off, ms."""
    seen_ms = None
    for period in range(round(_WATCHED_S / PERIOD_S)):
        if seen_ms is None and any(bench.error_state(node).name == "bus-off" for node in NODES):
            seen_ms = period * _MS
        bench.run(PERIOD_S)
    return seen_ms


def _measured(bench: Bench, baseline: Bench, bus_off_ms: float | None, case: Case) -> Outcome:
    phase = PHASES[case.phase]
    begin = round(BEFORE_S / PERIOD_S) + (not case.fault.needs_virtual_time)  # it goes over the bench channel
    trace = {name: column[begin:] for name, column in bench.trace.items()}
    before = int(bench.trace["controller_faults"][begin - 1])
    bits = np.nan_to_num(trace["controller_faults"]).astype(np.int64) & ~before
    noticed = dict(_noticed(bench, trace, bits, bus_off_ms))
    by = min(noticed, key=lambda one: noticed[one], default=Detector.NOBODY)
    states = trace["controller_state"]
    known = states[np.isfinite(states)]
    speed = np.abs(trace["motor_speed_rpm"])
    moving = np.flatnonzero(speed >= AT_REST_RPM)
    rest = int(moving[-1]) + 1 if moving.size else 0
    effect_mm = np.abs(trace["position_m"] - baseline.trace["position_m"][begin:]) * M_TO_MM
    return Outcome(
        by=by,
        detected_ms=noticed.get(by),
        signals=tuple(
            sorted(signal_name(str(one.name)) for one in ControllerFault(int(np.bitwise_or.reduce(bits))))
        ),
        state=State(int(states[-1])).name.lower() if np.isfinite(states[-1]) else "off",
        drive=Drive(int(trace["drive_state"][-1])).name.lower(),
        stayed=bool((known == (State.RUN if phase.is_enabled else State.STANDBY)).all()),
        at_rest_ms=rest * _MS if rest < len(speed) else None,
        speed_rpm=float(speed.max()),
        error_mm=float(np.abs(trace["error_m"]).max() * M_TO_MM),
        effect_mm=float(effect_mm.max()),
        end_effect_mm=float(effect_mm[-1]),
        bus_differs=not np.array_equal(_in_band(bench), _in_band(baseline)),
    )


def _course(bench: Bench) -> dict[str, np.ndarray]:
    trace = bench.trace
    course = {name: trace[name] for name in ("reference_m", "position_m", "motor_speed_rpm")}
    return {"time_s": trace["time_s"] - BEFORE_S} | course


def _in_band(bench: Bench) -> np.ndarray:
    traffic = bench.recording.traffic
    return traffic[~np.isin(traffic[:, 1], list(bench.contract.bench_channel_ids))]


def _noticed(
    bench: Bench, trace: dict[str, np.ndarray], bits: np.ndarray, bus_off_ms: float | None
) -> Iterator[tuple[Detector, float]]:
    """Yield who noticed, and when each did for the first time."""
    flagged = np.flatnonzero(bits)
    if flagged.size:
        yield Detector.CONTROLLER, float(flagged[0]) * _MS + _CONTROLLER_PHASE_MS
    stopping = np.flatnonzero(np.isin(trace["drive_state"], _DRIVE_STOPPING))
    if stopping.size:
        yield Detector.DRIVE, float(stopping[0]) * _MS
    traffic, since_ns = bench.recording.traffic, bench.recording.start_ns + round(BEFORE_S * 1e9)
    errors = traffic[(traffic[:, 1] & np.uint64(ERR_FLAG)).astype(bool) & (traffic[:, 0] >= since_ns), 0]
    times_ms = [(int(errors[0]) - since_ns) * 1e-6] if len(errors) else []
    times_ms += [bus_off_ms] if bus_off_ms is not None else []
    if times_ms:
        yield Detector.CAN, min(times_ms)


def _complaints(case: Case, outcome: Outcome, allowed_ms: float) -> Iterator[str]:
    expected, phase = case.expected, PHASES[case.phase]
    if outcome.by is not expected.by:
        yield f"noticed by {outcome.by}, not {expected.by}"
    elif outcome.detected_ms is not None and outcome.detected_ms > expected.within_ms:
        yield f"noticed after {outcome.detected_ms:g} ms, not {expected.within_ms:g}"
    if outcome.signals != expected.signals:
        yield f"signals {', '.join(outcome.signals) or 'none'}, not {', '.join(expected.signals) or 'none'}"
    if not phase.is_enabled:
        if outcome.at_rest_ms != 0.0:
            yield "the motor turned in standby"
        if outcome.state not in ("standby", "off"):
            yield f"the controller went from standby to {outcome.state}"
        return
    if expected.reaction.stops:
        yield from _not_stopped(expected.reaction, outcome, allowed_ms)
    elif not outcome.stayed:
        yield f"the controller did not stay in run but ended in {outcome.state}"
    elif expected.reaction is Reaction.TOLERATED and outcome.error_mm > expected.error_mm:
        yield f"error {outcome.error_mm:.3f} mm, not below {expected.error_mm:g} mm"
    elif (
        expected.reaction is Reaction.UNDETECTED
        and abs(outcome.end_effect_mm - expected.error_mm) > ABOUT * expected.error_mm
    ):
        yield f"{outcome.end_effect_mm:.3f} mm off in the end, not about {expected.error_mm:g} mm"


def _not_stopped(reaction: Reaction, outcome: Outcome, allowed_ms: float) -> Iterator[str]:
    if outcome.state not in _END_STATES[reaction]:
        yield f"the controller ended in {outcome.state}, not {_END_STATES[reaction][0]}"
    if outcome.drive == "operation_enabled" or (reaction is Reaction.DRIVE_STOP) != (
        outcome.drive == "fault"
    ):
        yield f"the drive ended in {outcome.drive}"
    if outcome.at_rest_ms is None:
        yield "the motor turned to the end"
    elif outcome.at_rest_ms > allowed_ms:
        yield f"the motor was at rest after {outcome.at_rest_ms:g} ms, not {allowed_ms:.1f}"
