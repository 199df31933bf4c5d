"""The closed loop over the bus: tracking figures, timing chart, bus load and latency."""

import numpy as np
import pytest
from bench_runs import played
from bit_by_bit import reference_bits

from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.frame import EFF_FLAG
from firmware_py.diagnosis import State
from firmware_py.kernel import layout as k
from firmware_py.node import EXECUTION_NS, PHASE_NS
from firmware_py.tuning import Tuning
from hil.closed_loop import play_closed_loop
from hil.scenario import CONTROLLERS, builtin_names, load_scenario
from hil.supervisor import BRING_UP_PERIODS

CONTRACT = Contract.load()
PERIOD_NS = 1_000_000
TABLE = ("sine", "sine_load", "lift_lower", "lift_lower_load")
LAWS = {"p": k.LAW_P, "pi": k.LAW_PI, "adrc": k.LAW_ADRC, "pi_ff": k.LAW_PI_FF, "scheduled": k.LAW_SCHEDULED}


# figures


@pytest.mark.parametrize("scenario", builtin_names())
def test_adrc_meets_its_gate_over_the_bus(scenario):
    result = played(scenario).result
    limits = load_scenario(scenario).limits["adrc"]
    assert result["complete"]
    assert result["rms_mm"] <= limits["rms_mm"]
    assert result["max_mm"] <= limits["max_mm"]
    assert result["within_limits"] is True


@pytest.mark.parametrize("scenario", TABLE)
def test_at_500_kbit_s_the_gates_still_hold_under_85_percent_bus_load(scenario):
    result = played(scenario, bit_rate=500_000).result
    assert result["within_limits"]
    assert result["bus_load_percent"] < 85.0


# timing chart


@pytest.mark.parametrize("scenario", TABLE)
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_bus_run_and_the_loop_without_a_bus_are_the_same_to_the_last_bit(controller, scenario):
    run = played(scenario, controller)
    twin = play_closed_loop(load_scenario(scenario), Tuning().calibration(), law=LAWS[controller])
    assert np.array_equal(run.trace["target_velocity_rpm"], twin.command_rpm)
    assert np.array_equal(run.trace["position_m"], twin.position_m)
    assert (run.result["rms_mm"], run.result["max_mm"]) == (twin.rms_mm, twin.max_mm)


def test_one_period_of_transport_delay():
    """The command computed from x(t_k) acts over [t_k+1, t_k+2)."""
    recording = played("sine").recording
    plant, controller = recording.plant, recording.controller
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


def ends_of(scenario: str, codec: MessageCodec) -> np.ndarray:
    """Bus times (ns) at which a message's frames ended."""
    traffic = played(scenario).recording.traffic
    return traffic[traffic[:, 1] == codec.can_id][:, 0].astype(np.int64)


def test_the_chart_of_one_period():
    """Feedback at +0, both inputs in by +0.5 ms, the command out at +0.6 ms and in before the next period."""
    feedback = ends_of("sine", CONTRACT.position_feedback) % PERIOD_NS
    setpoint = ends_of("sine", CONTRACT.position_setpoint) % PERIOD_NS
    command = ends_of("sine", CONTRACT.drive_command) % PERIOD_NS
    assert feedback.max() < setpoint.min()
    assert setpoint.max() < PHASE_NS
    shortest_bits = 34 + 8 * CONTRACT.drive_command.dlc + 10
    assert command.min() >= PHASE_NS + EXECUTION_NS + shortest_bits * 1000
    assert len(command) == 10_000 + BRING_UP_PERIODS


def test_latency_from_feedback_to_command_as_reported_and_as_counted_from_the_log():
    run = played("sine")
    feedback, command = (
        ends[ends >= run.recording.start_ns]
        for ends in (ends_of("sine", m) for m in (CONTRACT.position_feedback, CONTRACT.drive_command))
    )
    latency_us = (command - feedback) / 1e3
    reported = run.result["timing"]["latency_us"]
    assert reported["p50"] == pytest.approx(np.percentile(latency_us, 50))
    assert reported["p99"] == pytest.approx(np.percentile(latency_us, 99))
    assert reported["max"] == latency_us.max()
    assert latency_us.max() < 1000.0


def test_the_bus_load_is_the_share_of_time_that_frames_take():
    run = played("sine")
    traffic = run.recording.traffic.astype(np.uint64)
    bits = 0
    for message in CONTRACT.messages:
        frames = traffic[traffic[:, 1] == message.can_id]
        assert len(frames) > 0
        if not message.bench_channel:
            extended = bool(message.can_id & EFF_FLAG)
            identifiers = frames[:, 1] & np.uint64(EFF_FLAG - 1)
            bits += reference_bits(identifiers, extended, message.dlc, frames[:, 3]).sum()
    assert run.result["bus_load_percent"] == pytest.approx(100 * bits * 1e-6 / run.recording.simulated_s)


def test_every_message_keeps_its_cycle_time():
    for message in CONTRACT.messages:
        if not message.bench_channel:
            cycle_ns = np.median(np.diff(ends_of("sine", message)))
            assert cycle_ns == pytest.approx(message.cycle_time_ns, rel=0.01), message.name


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
