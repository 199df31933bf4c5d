"""The closed loop over the bus: tracking figures, timing chart, bus load and latency."""

import numpy as np
import pytest
from bench_runs import played

from dbc.contract import Contract
from firmware_py.node import EXECUTION_NS, PHASE_NS
from firmware_py.state_machine import State
from firmware_py.tuning import Tuning
from hil.bus.wire_time import classic_bits
from hil.closed_loop import run_closed_loop
from hil.references import load_profile, setpoint_counts
from hil.scenario import CONTROLLERS, builtin_names, load_scenario
from hil.supervisor import BRING_UP_PERIODS

CONTRACT = Contract.load()
PERIOD_NS = 1_000_000
TABLE = ("sine", "sine_load", "lift_lower", "lift_lower_load")
ADRC_GATES = {
    "sine": (0.10, 0.25),
    "sine_load": (0.20, 1.45),
    "lift_lower": (0.35, 1.6),
    "lift_lower_load": (0.45, 2.1),
}
DESIGN_FIGURES = {  # RMS, maximum, mm
    ("p", "sine"): (3.060, 5.007),
    ("p", "sine_load"): (3.525, 5.272),
    ("p", "lift_lower"): (2.422, 3.877),
    ("p", "lift_lower_load"): (2.990, 5.814),
    ("pi", "sine"): (1.262, 2.080),
    ("pi", "sine_load"): (1.407, 2.251),
    ("pi", "lift_lower"): (2.046, 5.586),
    ("pi", "lift_lower_load"): (2.446, 7.030),
}


# figures


@pytest.mark.parametrize("scenario", TABLE)
def test_adrc_meets_its_gate_over_the_bus(scenario):
    result = played(scenario).result
    rms_mm, max_mm = ADRC_GATES[scenario]
    assert result["limits"] == {"rms_mm": rms_mm, "max_mm": max_mm}
    assert result["rms_mm"] <= rms_mm
    assert result["max_mm"] <= max_mm
    assert result["within_limits"]


@pytest.mark.parametrize("scenario", TABLE)
def test_at_500_kbit_s_the_gates_still_hold_under_85_percent_bus_load(scenario):
    result = played(scenario, bit_rate=500_000).result
    assert result["within_limits"]
    assert result["bus_load_percent"] < 85.0


@pytest.mark.parametrize(("controller", "scenario"), DESIGN_FIGURES)
def test_p_and_pi_track_as_they_were_designed_to(controller, scenario):
    result = played(scenario, controller).result
    assert (result["rms_mm"], result["max_mm"]) == pytest.approx(
        DESIGN_FIGURES[controller, scenario], rel=0.05
    )


def test_adrc_follows_the_full_stroke():
    result = played("full_stroke").result
    assert result["complete"]
    assert result["within_limits"] in (True, None)
    assert result["max_mm"] < 2.0


def test_every_builtin_scenario_is_tested_here():
    assert set(builtin_names()) == {*TABLE, "full_stroke"}


# timing chart


def trace_and_records(scenario: str):
    run = played(scenario)
    return run.trace, run.recording.plant, run.recording.controller


def jitted_twin(name: str):
    """The same scenario in the compiled loop without the bus."""
    scenario = load_scenario(name)
    _, _, controller = trace_and_records(name)
    start_ns = played(name).recording.start_ns
    running_ns = controller["time_ns"][controller["state"] == State.RUN] + PHASE_NS
    hold_periods = int(start_ns - running_ns[0] + PHASE_NS) // PERIOD_NS
    time_s = np.arange(scenario.periods) * 1e-3
    return run_closed_loop(
        Tuning().calibration(),
        setpoint_counts(scenario.reference_m()),
        load_profile(time_s, scenario.load),
        hold_periods=hold_periods,
    )


@pytest.mark.parametrize("scenario", TABLE)
def test_the_bus_run_and_the_loop_without_a_bus_are_the_same_to_the_last_bit(scenario):
    trace, _, _ = trace_and_records(scenario)
    twin = jitted_twin(scenario)
    assert np.array_equal(trace["target_velocity_rpm"], twin.command_rpm)
    assert np.array_equal(trace["position_m"], twin.position_m)


def test_one_period_of_transport_delay():
    """The command computed from x(t_k) acts over [t_k+1, t_k+2)."""
    _, plant, controller = trace_and_records("sine")
    commanded = dict(
        zip(
            (controller["time_ns"] + PHASE_NS) // PERIOD_NS,
            controller["target_velocity_0p25rpm"],
            strict=True,
        )
    )
    rad_s_per_count = np.pi / 120
    for time_ns, speed_rad_s in zip(plant["time_ns"][200:], plant["speed_command_rad_s"][200:], strict=True):
        assert speed_rad_s == commanded[int(time_ns) // PERIOD_NS - 1] * rad_s_per_count


def test_the_controller_uses_the_sample_and_the_setpoint_of_its_own_period():
    run = played("sine")
    controller, plant, supervisor = run.recording.controller, run.recording.plant, run.recording.supervisor
    running = np.flatnonzero(controller["state"] == State.RUN)
    period = (controller["time_ns"][running] + PHASE_NS) // PERIOD_NS
    sampled_um = np.floor(plant["position_m"] * 1e6 + 0.5)
    assert np.array_equal(controller["position_um"][running], sampled_um[period])
    assert np.array_equal(controller["setpoint_0p1um"][running], supervisor["setpoint_raw"][period])


def ends_of(scenario: str, message: str) -> np.ndarray:
    """Bus times (ns) at which a message's frames ended."""
    traffic = played(scenario).recording.traffic
    return traffic[traffic[:, 1] == getattr(CONTRACT, message).can_id][:, 0].astype(np.int64)


def test_the_chart_of_one_period():
    """Feedback at +0, both inputs in by +0.5 ms, the command out at +0.6 ms and in before the next period."""
    phase = {
        name: ends_of("sine", name) % PERIOD_NS
        for name in ("position_feedback", "position_setpoint", "drive_command")
    }
    assert phase["position_feedback"].max() < phase["position_setpoint"].min()
    assert phase["position_setpoint"].max() < PHASE_NS
    assert phase["drive_command"].min() > PHASE_NS + EXECUTION_NS
    for name, codec in (("drive_command", CONTRACT.drive_command),):
        shortest = 34 + 8 * codec.dlc + 10
        assert phase[name].min() >= PHASE_NS + EXECUTION_NS + shortest * 1000
    assert len(ends_of("sine", "drive_command")) == 10_000 + BRING_UP_PERIODS


def test_latency_from_feedback_to_command_as_reported_and_as_counted_from_the_log():
    run = played("sine")
    feedback, command = ends_of("sine", "position_feedback"), ends_of("sine", "drive_command")
    latency_us = (command - feedback) / 1e3
    reported = run.result["latency_us"]
    assert reported["p50"] == pytest.approx(np.percentile(latency_us, 50))
    assert reported["p99"] == pytest.approx(np.percentile(latency_us, 99))
    assert reported["max"] == latency_us.max()
    assert latency_us.max() < 1000.0


def test_the_bus_load_is_the_share_of_time_that_frames_take():
    run = played("sine")
    bench = {message.can_id for message in CONTRACT.messages if message.bench_channel}
    traffic = run.recording.traffic.tolist()
    bits = sum(classic_bits(can_id, dlc, data) for _, can_id, dlc, data in traffic if can_id not in bench)
    assert run.result["bus_load_percent"] == pytest.approx(100 * bits * 1e-6 / run.recording.simulated_s)
    assert {row[1] for row in traffic} >= bench


def test_every_message_keeps_its_cycle_time():
    for message in CONTRACT.messages:
        if message.bench_channel:
            continue
        ends_ns = ends_of(
            "sine",
            {
                "DriveCommand": "drive_command",
                "PositionFeedback": "position_feedback",
                "PositionSetpoint": "position_setpoint",
                "ControllerCommand": "controller_command",
                "DriveStatus": "drive_status",
                "PressureFeedback": "pressure_feedback",
                "ControllerStatus": "controller_status",
                "ObserverState": "observer_state",
            }[message.name],
        )
        cycle = np.median(np.diff(ends_ns))
        assert cycle == pytest.approx(message.cycle_time_ns, rel=0.01), message.name


def test_no_input_is_ever_late_or_overwritten_in_a_full_run():
    for scenario in TABLE:
        controller = played(scenario).recording.controller
        started = controller["state"] == State.RUN
        first = int(np.argmax(started))
        assert started[first:].all()
        assert not controller["faults"][first:].any()


def test_the_load_step_happens():
    trace = played("sine_load").trace
    assert trace["load_n"][2990] == 0.0
    assert trace["load_n"][3010] == -2000.0


def test_the_recorded_load_is_the_one_that_acts_in_the_period():
    trace = played("sine_load").trace
    assert trace["load_n"][2999] == 0.0
    assert trace["load_n"][3000] == -2000.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_law_asked_for_is_the_one_that_runs(controller):
    traffic = played("sine", controller).recording.traffic
    status = CONTRACT.controller_status
    last = traffic[traffic[:, 1] == status.can_id][-1]
    assert status.unpack(int(last[3])).control_law == 1 + CONTROLLERS.index(controller)
