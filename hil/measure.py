"""From what a run left to a trace by control period and to figures."""

import hashlib
import math
from typing import Any

import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.node import PHASE_NS
from firmware_py.state_machine import State
from firmware_py.task import Fault
from hil.bus.wire_time import classic_bits
from hil.run.options import Recording, RunOptions
from hil.scenario import PERIOD_S, Scenario, TimingLimits
from hil.timing import Timing, timing_of

M_TO_MM = 1e3
PA_TO_BAR = 1e-5
RAD_S_TO_RPM = 30.0 / math.pi

PLANT_COLUMNS = (  # trace column, record column, factor
    ("position_m", "position_m", 1.0),
    ("velocity_m_s", "velocity_m_s", 1.0),
    ("pressure_a_bar", "pressure_a_pa", PA_TO_BAR),
    ("pressure_b_bar", "pressure_b_pa", PA_TO_BAR),
    ("pressure_accumulator_bar", "pressure_accumulator_pa", PA_TO_BAR),
    ("motor_speed_rpm", "motor_speed_rad_s", RAD_S_TO_RPM),
    ("load_n", "load_n", 1.0),
    ("drive_state", "drive_state", 1.0),
)
CONTROLLER_COLUMNS = (
    ("position_measured_m", "position_um", 1e-6),
    ("target_velocity_rpm", "target_velocity_0p25rpm", 0.25),
    ("controller_state", "state", 1.0),
    ("controller_faults", "faults", 1.0),
)
OBSERVER_COLUMNS = (  # trace column, record column, signal of ObserverState that carries its factor
    ("td_position_m", "v1", "TdPosition"),
    ("td_velocity_m_s", "v2", "TdVelocity"),
    ("td_acceleration_m_s2", "v3", "TdAcceleration"),
    ("eso_position_m", "z1", "EsoPosition"),
    ("eso_velocity_m_s", "z2", "EsoVelocity"),
    ("eso_acceleration_m_s2", "z3", "EsoAcceleration"),
    ("eso_disturbance_m_s3", "z4", "EsoDisturbance"),
)

Trace = dict[str, np.ndarray]


def trace_of(recording: Recording, scenario: Scenario, contract: Contract) -> Trace:
    """Merge the nodes' records by control period.

    Returns
    -------
    trace : dict of ndarray
        One row per control period k = 0, 1, ... of the scenario that was played; NaN where a node has no row.
    """
    played = round(recording.simulated_s / PERIOD_S) - _first_period(recording)
    rows = max(min(played, scenario.periods), 0)
    trace = {"time_s": np.arange(rows) * PERIOD_S, "reference_m": scenario.reference_m()[:rows]}
    signals = contract.observer_state.signals
    observer = tuple((name, source, signals[signal].factor) for name, source, signal in OBSERVER_COLUMNS)
    sources = (
        (recording.plant, PLANT_COLUMNS, 0),
        (recording.controller, CONTROLLER_COLUMNS + observer, PHASE_NS),
    )
    for record, columns, phase_ns in sources:
        if record is None:
            continue
        period = ((record["time_ns"] + phase_ns - recording.start_ns) // PERIOD_NS).astype(int)
        inside = (period >= 0) & (period < rows)
        for name, source, factor in columns:
            trace[name] = np.full(rows, np.nan)
            trace[name][period[inside]] = record[source][inside] * factor
    if "position_m" in trace:
        trace["error_m"] = trace["reference_m"] - trace["position_m"]
    return trace


def result_of(
    recording: Recording, trace: Trace, contract: Contract, options: RunOptions, mode: str
) -> dict[str, Any]:
    """Return the figures of a run, as written to ``result.json``.

    RMS and maximum are over e(t_k) = r(t_k) - x(t_k), x being the plant's unquantised position.
    """
    scenario = options.scenario
    error_mm = trace.get("error_m", np.full(1, np.nan)) * M_TO_MM
    speed_steps_rpm = np.diff(trace.get("target_velocity_rpm", np.full(1, np.nan)))
    speed_steps_rpm = speed_steps_rpm[np.isfinite(speed_steps_rpm)]
    rms_mm = _finite(np.sqrt(np.nanmean(error_mm**2))) if np.isfinite(error_mm).any() else None
    max_mm = _finite(np.nanmax(np.abs(error_mm))) if np.isfinite(error_mm).any() else None
    limits = scenario.limits.get(options.controller)
    timing = timing_in(recording, trace, contract, options.wire_bit_rate, mode)
    complete = not recording.ending
    within, verdict = None, ""
    if complete:
        tracking = _tracking_within(limits, rms_mm, max_mm)
        within, verdict = _judged(trace, limits, tracking, timing, scenario.timing)
    return {
        "scenario": scenario.name,
        "controller": options.controller,
        "mode": mode,
        "complete": complete,
        "ending": recording.ending,
        "rms_mm": rms_mm,
        "max_mm": max_mm,
        "chatter_rpm_per_period": float(np.sqrt(np.mean(speed_steps_rpm**2)))
        if speed_steps_rpm.size
        else None,
        "limits": limits,
        "within_limits": within,
        "verdict": verdict,
        "paper": scenario.paper.get(options.controller),
        "bit_rate": options.wire_bit_rate,
        "bus_load_percent": bus_load_percent(recording, contract, options.wire_bit_rate),
        "timing": timing.summary(),
        "timing_limits": scenario.timing.given() or None,
        "bus_frames": len(recording.traffic),
        "bus_sha256": hashlib.sha256(recording.traffic.astype("<u8").tobytes()).hexdigest(),
        "scenario_start_bus_s": recording.start_ns / 1e9,
        "simulated_s": recording.simulated_s,
        "wall_s": recording.wall_s,
        "startup_s": recording.startup_s,
        "realtime_factor": recording.simulated_s / recording.wall_s,
        "notes": recording.notes,
    }


def _tracking_within(
    limits: dict[str, float] | None, rms_mm: float | None, max_mm: float | None
) -> bool | None:
    if not limits or rms_mm is None or max_mm is None:
        return None
    return rms_mm <= limits["rms_mm"] and max_mm <= limits["max_mm"]


def _judged(
    trace: Trace,
    limits: dict[str, float] | None,
    tracking: bool | None,
    timing: Timing,
    timing_limits: TimingLimits,
) -> tuple[bool | None, str]:
    """Return whether all limits were met, None if they cannot be judged or there are none, and what broke."""
    complaints = []
    if left := left_run(trace):
        complaints.append(left)
    elif tracking is False:
        complaints.append("the scenario's limits were missed")
    if broken := timing.violations(timing_limits):
        times = "once" if len(broken) == 1 else f"{len(broken)} times"
        complaints.append(f"timing limits were broken {times}, first in {broken[0]}")
    if complaints:
        return False, "; ".join(complaints)
    return (tracking if limits else bool(timing_limits.given()) or None), ""


def left_run(trace: Trace) -> str:
    """Return when and why the controller was not in Run during the scenario, or nothing."""
    state = trace.get("controller_state", np.empty(0))
    outside = np.flatnonzero(np.isfinite(state) & (state != State.RUN))
    if not outside.size:
        return ""
    first = outside[0]
    faults = Fault(int(trace["controller_faults"][first]))
    why = ", ".join(str(fault.name).lower() for fault in Fault if fault in faults) or "no fault"
    state_name = State(int(state[first])).name.lower()
    time_s = trace["time_s"][first]
    return (
        f"the controller was in {state_name} at {time_s:.3f} s ({why}): the errors are not those of tracking"
    )


def bus_load_percent(recording: Recording, contract: Contract, bit_rate: int) -> float:
    """Return the share of bus time that the frames take at `bit_rate`, the bench channel left out."""
    bench = {message.can_id for message in contract.messages if message.bench_channel}
    frames = recording.traffic.tolist()
    bits = sum(classic_bits(can_id, dlc, data) for _, can_id, dlc, data in frames if can_id not in bench)
    return 100.0 * bits / bit_rate / recording.simulated_s if recording.simulated_s else 0.0


def timing_in(recording: Recording, trace: Trace, contract: Contract, bit_rate: int, mode: str) -> Timing:
    """Return the timing of the scenario's periods, those of the bring-up left out.

    Of a real-time run the last period is left out, too: it is stopped at that period's start.
    """
    periods = len(trace["time_s"]) - (mode == "realtime")
    controller = recording.controller
    return timing_of(
        recording.traffic,
        contract,
        bit_rate,
        recording.start_ns,
        recording.start_ns + periods * PERIOD_NS,
        None if controller is None else controller["time_ns"] + PHASE_NS,
    )


def _first_period(recording: Recording) -> int:
    """Periods that were played before the scenario's first one."""
    return round((recording.start_ns - int(recording.supervisor["time_ns"][0])) / PERIOD_NS)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
