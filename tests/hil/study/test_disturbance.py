"""The true total disturbance against a finely stepped plant; the observer's lag against theory."""

from pathlib import Path

import numpy as np
import pytest

from dbc.contract import Contract
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.tuning import AdrcTuning
from hil.measure import trace_of
from hil.run.inprocess import run_inprocess
from hil.run.options import RunOptions
from hil.scenario import load_scenario
from hil.study.disturbance import observer_error, true_disturbance_m_s3
from plant_sim import simulate

FINE_S = 1e-5
NO_MODEL = AdrcTuning(b0_m_s2_per_rad=0.0, a1n_per_s2=0.0, a2n_per_s=0.0)
"""With it all of the jerk is disturbance."""


def record_of(speed_rad_s: np.ndarray, **options: float) -> dict[str, np.ndarray]:
    trace = simulate(speed_rad_s, dt_s=FINE_S, **options)
    return {
        "position_m": trace.position_m,
        "velocity_m_s": trace.velocity_m_s,
        "pressure_a_pa": trace.pressure_a_pa,
        "pressure_b_pa": trace.pressure_b_pa,
        "pressure_accumulator_pa": trace.pressure_accumulator_pa,
        "motor_speed_rad_s": trace.motor_speed_rad_s,
        "speed_command_rad_s": trace.speed_command_rad_s,
        "load_n": trace.load_force_n,
    }


def sine_speed(mean_rad_s: float = 50.0) -> np.ndarray:
    return mean_rad_s + 50.0 * np.sin(2 * np.pi * 20.0 * FINE_S * np.arange(20_000))


@pytest.mark.parametrize("initial_position_m", [0.05, 0.2, 0.35])
def test_the_jerk_is_what_the_velocity_does(initial_position_m):
    record = record_of(sine_speed(), initial_position_m=initial_position_m)
    jerk = true_disturbance_m_s3(record, NO_MODEL)[2:-2]
    measured = np.gradient(np.gradient(record["velocity_m_s"], FINE_S), FINE_S)[2:-2]
    difference = np.abs(jerk - measured) / np.abs(measured).max()
    assert np.percentile(difference, 99) < 1e-3  # valves that open between two steps make the rest


def test_a_constant_load_acts_and_its_step_does_not_show():
    speed, load_n = sine_speed(), np.where(np.arange(20_000) < 10_000, 0.0, -500.0)
    record = record_of(speed, load_force_n=load_n, initial_position_m=0.2)
    jerk = true_disturbance_m_s3(record, NO_MODEL)
    measured = np.gradient(np.gradient(record["velocity_m_s"], FINE_S), FINE_S)
    at_step = slice(9_990, 10_010)
    assert np.abs(measured[at_step]).max() > 20 * np.abs(jerk).max()
    later = slice(10_010, -2)
    assert np.percentile(np.abs(jerk - measured)[later], 99) < 1e-3 * np.abs(measured[later]).max()


def test_the_nominal_model_is_subtracted_term_by_term():
    record = record_of(sine_speed()[:100], initial_position_m=0.2)
    speed, velocity = record["speed_command_rad_s"], record["velocity_m_s"]
    jerk = true_disturbance_m_s3(record, NO_MODEL)
    model = AdrcTuning(b0_m_s2_per_rad=70.0, a1n_per_s2=-5e4, a2n_per_s=0.0)
    assert true_disturbance_m_s3(record, model) == pytest.approx(jerk + 5e4 * velocity - 70.0 * speed)
    acceleration = np.gradient(velocity, FINE_S)[1:-1]
    damped = true_disturbance_m_s3(record, AdrcTuning(b0_m_s2_per_rad=0.0, a1n_per_s2=0.0, a2n_per_s=-30.0))[
        1:-1
    ]
    assert damped - jerk[1:-1] == pytest.approx(30.0 * acceleration, rel=1e-2, abs=1e-3)


def test_a_delayed_observer_is_found_to_be_delayed_and_else_right():
    true = np.sin(np.arange(2000) / 50.0)
    error = observer_error(np.roll(true, 17), true)
    assert error.delay_ms == 17
    assert error.delayed_relative < 1e-6
    assert error.true_rms_m_s3 == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert error.relative == pytest.approx(error.rms_m_s3 / error.true_rms_m_s3)
    assert error.relative == pytest.approx(2 * np.sin(17 / 50.0 / 2), rel=0.02)


def test_the_observer_lags_the_truth_as_a_linear_observer_of_its_bandwidth():
    """The lag of z4 at low frequency follows from the observer's characteristic polynomial."""
    adrc = AdrcTuning()
    omega, a1n = adrc.omega_o_rad_s, adrc.a1n_per_s2
    linear_lag_ms = 1e3 * (4 * omega**3 - 4 * omega * a1n) / omega**4
    recording = run_inprocess(
        RunOptions(scenario=load_scenario("sine"), tuning=chosen_tuning("paper"), record_directory=Path())
    )
    assert recording.plant is not None
    played = recording.plant["time_ns"] >= recording.start_ns
    true = true_disturbance_m_s3({name: column[played] for name, column in recording.plant.items()}, adrc)
    trace = trace_of(recording, Contract.load())
    error = observer_error(trace["eso_disturbance_m_s3"], true)
    assert error.delay_ms == pytest.approx(linear_lag_ms, abs=3)
    assert error.delayed_relative < 0.01
