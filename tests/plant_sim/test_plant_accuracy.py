"""The compiled integrator against an independent implementation integrated by Radau at rtol 1e-9."""

import numpy as np
import pytest
from radau_reference import Machine, integrate

from plant_sim import PlantParameters, PumpModel, advance, initial_state
from plant_sim import layout as at

PERIOD_S = 1e-3
SUBSTEPS = 10


def replay(state, commands, loads, parameters, substeps=SUBSTEPS):
    state = state.copy()
    p = parameters.vector()
    states = [state.copy()]
    for command, load in zip(commands, loads, strict=True):
        advance(state, p, command, load, PERIOD_S, substeps)
        states.append(state.copy())
    return np.array(states)


def sine_record(start_s, periods, load_n=0.0):
    """Motor speeds in 0.25 rpm steps that make the rod follow the sine of eq. (28), one period late."""
    parameters = PlantParameters()
    p = parameters.vector()
    state = initial_state(parameters, reference_m(start_s))
    count = np.pi / 120.0
    commands = [0.0]
    for k in range(periods - 1):
        error = reference_m(start_s + k * PERIOD_S) - state[at.POSITION]
        advance(state, p, commands[-1], load_n, PERIOD_S, SUBSTEPS)
        commands.append(round(31100.0 * error / count) * count)
    return np.array(commands)


def reference_m(time_s):
    return 0.15 * np.sin(0.2 * np.pi * time_s - np.pi / 2.0) + 0.15


def position_error_um(start_m, commands, loads, parameters=PlantParameters(), machine=Machine()):  # noqa: B008
    loads = np.broadcast_to(loads, np.shape(commands))
    state = initial_state(parameters, start_m)
    reference = integrate(state, commands, loads, machine)
    ours = replay(state, commands, loads, parameters)
    return np.abs(ours - reference)[:, at.POSITION].max() * 1e6


@pytest.mark.parametrize(("start_s", "load_n"), [(0.0, 0.0), (2.5, 0.0), (7.0, 0.0), (7.0, -2000.0)])
def test_position_on_the_sine_is_within_a_tenth_of_a_micrometre(start_s, load_n):
    commands = sine_record(start_s, 100, load_n)
    assert position_error_um(reference_m(start_s), commands, load_n) < 0.1


@pytest.mark.parametrize(
    ("start_m", "speed_rad_s", "load_n"),
    [(0.01, -314.0, 0.0), (0.395, 314.0, -2000.0), (0.38, 314.0, -20000.0)],
    ids=["retracted stop", "extended stop", "extended stop, pulled"],
)
def test_position_is_within_ten_micrometres_when_driven_into_a_stop(start_m, speed_rad_s, load_n):
    assert position_error_um(start_m, np.full(200, speed_rad_s), load_n) < 10.0


def test_every_valve_opens_in_the_worst_case_that_is_compared():
    parameters = PlantParameters()
    states = replay(initial_state(parameters, 0.395), np.full(200, 314.0), np.full(200, -2000.0), parameters)
    assert states[:, at.PRESSURE_A].max() > parameters.relief_valve_crack_pa
    assert states[:, [at.PRESSURE_A, at.PRESSURE_B]].min() < 3e5 - parameters.check_valve_crack_pa
    assert states[:, at.POSITION].max() > parameters.stroke_m


def test_a_load_reversal_of_forty_kilonewton_is_within_a_micrometre():
    commands = np.r_[np.full(50, 100.0), np.full(50, -200.0)]
    assert position_error_um(0.2, commands, np.r_[np.full(40, 2e4), np.full(60, -2e4)]) < 1.0


def test_constant_efficiency_pumps_follow_the_reference():
    parameters = PlantParameters(pump_model=PumpModel.CONSTANT, leak_m3_per_s_pa=0.0)
    machine = Machine(leak=0.0, constant_pumps=True)
    assert position_error_um(0.1, np.full(60, 150.0), 0.0, parameters, machine) < 0.1


def test_a_machine_that_changes_under_way_follows_the_reference():
    """Soft oil, worn pumps, lost gas, relief valves stuck open, a heavier load, from the old state on."""
    state = initial_state(PlantParameters(), 0.2)
    parameters = PlantParameters().scaled(
        bulk_modulus=0.4, efficiency=0.8, leak=3.0, precharge=0.6, relief_crack=0.0, mass=1.4
    )
    machine = Machine(
        bulk_modulus=2.8e8, efficiency=0.68, leak=6e-11, precharge=2.1e5, relief_crack=0.0, mass=1.4
    )
    commands, loads = np.r_[np.full(60, 200.0), np.full(60, -100.0)], np.zeros(120)
    error = np.abs(replay(state, commands, loads, parameters) - integrate(state, commands, loads, machine))
    assert error[:, at.POSITION].max() * 1e6 < 0.1
    assert error[:, at.OIL_VOLUME].max() < 1e-9


def test_pressures_and_oil_volume_follow_the_reference():
    commands = sine_record(7.0, 60)
    parameters = PlantParameters()
    state = initial_state(parameters, reference_m(7.0))
    reference = integrate(state, commands, np.zeros(60))
    error = np.abs(replay(state, commands, np.zeros(60), parameters) - reference).max(axis=0)
    assert error[at.PRESSURE_A] < 1000.0
    assert error[at.PRESSURE_B] < 1000.0
    assert error[at.OIL_VOLUME] < 1e-9
    assert error[at.MOTOR_SPEED] < 1e-6


def test_the_error_falls_with_the_square_of_the_substep():
    parameters = PlantParameters()
    commands, loads = sine_record(2.5, 100), np.zeros(100)
    state = initial_state(parameters, reference_m(2.5))
    *coarse, exact = (
        replay(state, commands, loads, parameters, n)[-1, at.POSITION] for n in (5, 10, 20, 320)
    )
    errors = np.abs(np.array(coarse) - exact)
    assert errors[:-1] / errors[1:] == pytest.approx(4.0, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("load_n", [0.0, -2000.0])
def test_position_over_the_whole_sine_is_within_a_tenth_of_a_micrometre(load_n):
    assert position_error_um(0.0, sine_record(0.0, 10_000, load_n), load_n) < 0.1


@pytest.mark.long
def test_position_over_a_stroke_from_stop_to_stop_is_within_ten_micrometres():
    commands = np.r_[np.full(2500, 314.0), np.full(2500, -314.0)]
    assert position_error_um(0.0, commands, -2000.0) < 10.0
