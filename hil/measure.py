"""From what a run left to a trace by control period and to figures."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.diagnosis import Fault, State
from firmware_py.node import PHASE_NS
from hil.bus.wire_time import traffic_bits
from hil.faults.fault import Fault as InjectedFault
from hil.run.options import Recording, RigOptions, RunOptions
from hil.scenario import PERIOD_S, TimingLimits
from hil.signals import Series, signal_of
from hil.supervisor import BRING_UP_PERIODS
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

BUS_COLUMNS = {  # of a side without a record: trace column, signal
    "plant": (
        ("position_m", "PositionFeedback.Position"),
        ("motor_speed_rpm", "DriveStatus.ActualVelocity"),
    ),
    "controller": (
        ("position_measured_m", "PositionFeedback.Position"),
        ("target_velocity_rpm", "DriveCommand.TargetVelocity"),
    ),
}

METRICS = {  # key in result.json, sweep.json and tables.json: what it is, decimals
    "rms_mm": ("RMS error / mm", 3),
    "max_mm": ("maximum error / mm", 3),
    "chatter_rpm_per_period": ("speed chatter / rpm per period", 2),
}

Trace = dict[str, np.ndarray]


def trace_of(recording: Recording, contract: Contract) -> Trace:
    """Merge the nodes' records by control period; without a side's record, what the bus shows of it.

    Returns
    -------
    trace : dict of ndarray
        One row per control period k = 0, 1, ... of the scenario that was played; NaN where there is none.
    """
    rows = max(round(recording.simulated_s / PERIOD_S) - BRING_UP_PERIODS, 0)
    signals = contract.observer_state.signals
    observer = tuple((name, source, signals[signal].factor) for name, source, signal in OBSERVER_COLUMNS)
    trace = {"time_s": np.arange(rows) * PERIOD_S}
    sources = (
        (recording.supervisor, (("reference_m", "reference_m", 1.0),), 0),
        (recording.plant, PLANT_COLUMNS, 0),
        (recording.controller, CONTROLLER_COLUMNS + observer, PHASE_NS),
    )
    for record, columns, phase_ns in sources:
        if record is not None:
            period = ((record["time_ns"] + phase_ns - recording.start_ns) // PERIOD_NS).astype(int)
            for name, source, factor in columns:
                trace[name] = _by_period(rows, period, record[source] * factor)
    for side, shown in BUS_COLUMNS.items():
        if getattr(recording, side) is None:
            for name, signal in shown:
                series = signal_of(recording.traffic, contract, signal, recording.start_ns)
                period = np.floor(series.time_s / PERIOD_S).astype(int)
                trace[name] = _by_period(rows, period, series.values)
    trace["error_m"] = trace["reference_m"] - trace["position_m"]
    return trace


def _by_period(rows: int, period: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values laid out by period; NaN where there is none."""
    column = np.full(rows, np.nan)
    inside = (period >= 0) & (period < rows)
    column[period[inside]] = values[inside]
    return column


def figures_of(
    recording: Recording,
    trace: Trace,
    timing: Timing,
    contract: Contract,
    bit_rate: int,
    mode: str,
    faults: Sequence[InjectedFault],
) -> dict[str, Any]:
    """Return what was measured in a run, and what went wrong in it.

    RMS and maximum are over e(t_k) = r(t_k) - x(t_k), x being the plant's unquantised position, or, where
    the plant left no record, the measured one on the bus.
    """
    injected: Any = recording.notes.get("injected_faults", [])
    error_mm = Series(trace["time_s"], trace["error_m"] * M_TO_MM)
    chatter_rpm = Series(trace["time_s"][1:], np.diff(trace["target_velocity_rpm"]))
    return {
        "mode": mode,
        "complete": not recording.ending,
        "ending": recording.ending,
        "position": "plant" if recording.plant is not None else "bus",
        "rms_mm": error_mm.rms if error_mm.known.size else None,
        "max_mm": error_mm.max if error_mm.known.size else None,
        "chatter_rpm_per_period": chatter_rpm.rms if chatter_rpm.known.size else None,
        "bit_rate": bit_rate,
        "data_bit_rate": recording.data_bit_rate,
        "bus_load_percent": bus_load_percent(recording, contract, bit_rate),
        "timing": timing.summary(),
        "bus_frames": len(recording.traffic),
        "bus_sha256": _sha256(recording),
        "scenario_start_bus_s": recording.start_ns / 1e9,
        "simulated_s": recording.simulated_s,
        "wall_s": recording.wall_s,
        "startup_s": recording.startup_s,
        "realtime_factor": recording.simulated_s / recording.wall_s if recording.wall_s else 0.0,
        "faults": [fault.table for fault in faults] + injected,
        "reproducible": mode != "realtime" and not injected and not recording.notes.get("injections"),
        "notes": recording.notes,
    }


def setting_of(options: RigOptions) -> dict[str, Any]:
    """Return the firmware, its tuning and the plant's machine; None of a side that was started elsewhere."""
    firmware = {"name": options.firmware.name, "execution_us": options.firmware.execution_ns / 1e3}
    return {
        "firmware": firmware if "controller" in options.started else None,
        "tuning": options.tuning.name if "controller" in options.started else None,
        "machine": asdict(options.machine) if "plant" in options.started else None,
    }


def result_of(
    recording: Recording, trace: Trace, contract: Contract, options: RunOptions, mode: str
) -> dict[str, Any]:
    """Return a scenario's figures and the verdict on them, as written to ``result.json``."""
    scenario, bit_rate = options.scenario, options.wire_bit_rate
    timing = timing_in(recording, trace, contract, bit_rate, mode)
    figures = figures_of(recording, trace, timing, contract, bit_rate, mode, scenario.faults)
    limits = scenario.limits.get(options.controller)
    within, verdict = None, ""
    if not recording.ending:
        tracking = _tracking_within(limits, figures["rms_mm"], figures["max_mm"])
        within, verdict = _judged(trace, limits, tracking, timing, scenario.timing)
    return {
        "scenario": scenario.name,
        "controller": options.controller,
        **setting_of(options),
        **figures,
        "limits": limits,
        "timing_limits": scenario.timing.given() or None,
        "within_limits": within,
        "verdict": verdict,
        "paper": scenario.paper.get(options.controller),
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
    why = ", ".join(str(fault.name).lower() for fault in faults) or "no fault"
    state_name = State(int(state[first])).name.lower()
    time_s = trace["time_s"][first]
    return (
        f"the controller was in {state_name} at {time_s:.3f} s ({why}): the errors are not those of tracking"
    )


def overrun_of(result: dict[str, Any]) -> str:
    """Say of how many periods of a real-time run the machine was too late, or nothing."""
    missed, late = (result["timing"][count] for count in ("missed_periods", "late_periods"))
    if result["mode"] != "realtime" or not missed + late:
        return ""
    return (
        f"{missed} of {result['timing']['periods']} periods missed, {late} late: this machine or its bus did "
        f"not keep up; try --rt-ratio below {result['notes']['rt_ratio']:g}"
    )


def bus_load_percent(recording: Recording, contract: Contract, bit_rate: int) -> float:
    """Return the share of bus time that the frames take at `bit_rate`, the bench channel left out."""
    _, bits = _carried(recording, contract, bit_rate)
    return 100.0 * bits.sum() / bit_rate / recording.simulated_s if recording.simulated_s else 0.0


def bus_load_of_windows(recording: Recording, contract: Contract, bit_rate: int, window_s: float) -> Series:
    """Return the bus load in % of each whole window since the scenario began, at the windows' ends.

    A frame counts in the window in which it ends, error frames with what they destroyed.
    """
    if not window_s > 0.0:
        raise ValueError(f"a window is longer than nothing, not {window_s} s")
    ends_ns, bits = _carried(recording, contract, bit_rate)
    length_s = recording.simulated_s - recording.start_ns * 1e-9
    edges_s = np.arange(int(length_s / window_s + 1e-9) + 1) * window_s
    inside, _ = np.histogram((ends_ns - float(recording.start_ns)) * 1e-9, edges_s, weights=bits)
    return Series(edges_s[1:], 100.0 * inside / bit_rate / window_s)


def _carried(recording: Recording, contract: Contract, bit_rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ends (bus time, ns) and lengths (bits at `bit_rate`) of all frames but the bench channel's."""
    carried = recording.traffic[~np.isin(recording.traffic[:, 1], list(contract.bench_channel_ids))]
    nominal, fast = traffic_bits(carried).T
    return carried[:, 0], nominal + fast * (bit_rate / recording.data_bit_rate)


def _sha256(recording: Recording) -> str:
    """Return the hash of every frame's time, id, dlc and data."""
    digest = hashlib.sha256(recording.traffic.astype("<u8").tobytes())
    digest.update(recording.payloads.astype("<u8").tobytes())
    return digest.hexdigest()


def timing_in(recording: Recording, trace: Trace, contract: Contract, bit_rate: int, mode: str) -> Timing:
    """Return the timing of the scenario's periods, those of the bring-up left out.

    Of a real-time run the last period is left out, too: what belongs to it may come late.
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
        recording.execution_ns,
    )
