"""Rest, and runs from arrays."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim import PlantParameters, PumpModel, advance, initial_state, simulate
from plant_sim import layout as at
from plant_sim.hydraulics import chamber_volumes

P = PlantParameters()


def test_retracted_the_rod_rests_three_micrometres_inside_the_stop():
    state = initial_state(P)
    assert state[at.POSITION] == pytest.approx(-2.93e-6, rel=0.01)
    assert state[at.PRESSURE_A] == state[at.PRESSURE_B] == 3.5e5
    assert state[at.OIL_VOLUME] == 0.0


def test_retracted_rest_lasts():
    trace = simulate(np.zeros(10_000))
    assert np.ptp(trace.position_m) < 1e-12
    assert np.ptp(trace.pressure_a_pa) < 1e-3


@settings(max_examples=25, deadline=None)
@given(position_m=st.floats(1e-4, P.stroke_m), mass=st.floats(0.2, 1.5))
def test_at_rest_anywhere_forces_balance_and_valves_are_shut(position_m, mass):
    parameters = P.scaled(mass=mass)
    state = initial_state(parameters, position_m)
    line_pa = simulate([0.0], parameters=parameters, initial_position_m=position_m).pressure_accumulator_pa[0]
    assert min(state[at.PRESSURE_A], state[at.PRESSURE_B]) == pytest.approx(line_pa)
    advance(state, parameters.vector(), 0.0, 0.0, 1e-6, 1)
    assert abs(state[at.VELOCITY]) < 1e-5


def test_with_a_leak_and_a_still_motor_the_held_load_creeps_in():
    trace = simulate(np.zeros(1000), initial_position_m=0.2)
    assert 0.001 < 0.2 - trace.position_m[-1] < 0.01


@given(position_m=st.floats(0.0, P.stroke_m))
def test_the_machine_holds_the_same_oil_wherever_it_starts(position_m):
    state = initial_state(P, position_m)
    swept_m3 = P.rod_area_m2 * position_m
    rises_pa = state[[at.PRESSURE_A, at.PRESSURE_B]] - P.accumulator_precharge_pa
    compressed_m3 = np.dot(chamber_volumes(position_m, P.vector()), rises_pa) / P.bulk_modulus_pa
    assert state[at.OIL_VOLUME] + swept_m3 + compressed_m3 == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("position_m", [-0.001, 0.401, float("nan")])
def test_a_start_outside_the_stroke_is_refused(position_m):
    with pytest.raises(ValueError, match=r"^position_m is "):
        initial_state(P, position_m)


def test_samples_are_taken_at_the_start_of_each_period():
    trace = simulate([100.0, 100.0, 100.0])
    assert trace.time_s == pytest.approx([0.0, 1e-3, 2e-3])
    assert trace.motor_speed_rad_s == pytest.approx([0.0, 4.0, 8.0])
    assert trace.position_m[0] == initial_state(P)[at.POSITION]


def test_load_may_be_a_number_or_an_array():
    commands = np.full(50, 100.0)
    constant = simulate(commands, -300.0)
    varying = simulate(commands, np.full(50, -300.0))
    assert (constant.position_m == varying.position_m).all()


def test_halving_the_period_changes_nothing_but_the_sampling():
    coarse = simulate(np.full(200, 80.0), dt_s=1e-3)
    fine = simulate(np.full(400, 80.0), dt_s=5e-4)
    assert fine.position_m[::2] == pytest.approx(coarse.position_m, abs=1e-12)


def test_equal_runs_are_equal_to_the_last_bit():
    first, second = (simulate(np.full(500, -50.0), -100.0, initial_position_m=0.2) for _ in range(2))
    assert (first.position_m == second.position_m).all()


def test_traces_are_frozen():
    with pytest.raises(FrozenInstanceError):
        simulate([0.0]).position_m = None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0, np.nan],), "speed_command_rad_s holds NaN"),
        (([0.0], [np.inf]), "load_force_n holds NaN"),
        (([0.0, 1.0], [0.0]), "load_force_n has shape"),
        (([[0.0]],), "speed_command_rad_s has 2 dimensions"),
        ((["fast"],), "speed_command_rad_s is not an array"),
        (([0.0], 0.0, 0.0), "dt_s is 0.0"),
        (([0.0], 0.0, -1e-3), "dt_s is -0.001"),
        (([0.0], 0.0, np.nan), "dt_s is nan"),
    ],
)
def test_bad_arrays_are_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}") as refused:
        simulate(*arguments)
    assert "\n" not in str(refused.value)


def follow_sine(parameters):
    """P control of the sine of eq. (28), one period late: control errors in m and largest pressure in Pa."""
    state = initial_state(parameters)
    p = parameters.vector()
    command, errors, largest_pa = 0.0, [], 0.0
    for k in range(10_000):
        error = 0.15 * np.sin(0.2e-3 * np.pi * k - np.pi / 2.0) + 0.15 - state[at.POSITION]
        errors.append(error)
        advance(state, p, command, 0.0, 1e-3, 10)
        largest_pa = max(largest_pa, state[at.PRESSURE_A], state[at.PRESSURE_B])
        command = 31100.0 * error
    return np.array(errors), largest_pa


def test_p_control_of_the_sine_has_the_papers_table_4_errors():
    """Gain 31 100 rad/s per m was fitted to this row: calibration, not validation."""
    errors_m, largest_pa = follow_sine(P)
    assert np.sqrt(np.mean(errors_m**2)) == pytest.approx(2.985e-3, rel=0.03)
    assert np.abs(errors_m).max() == pytest.approx(5.132e-3, rel=0.03)
    assert largest_pa < 12e5


def test_without_a_leak_the_papers_pumps_trap_oil_until_the_relief_valves_open():
    """Pump ratio 0.718 against area ratio 0.75: eqs (1), (2) push in more than they let out."""
    sealed = PlantParameters(pump_model=PumpModel.CONSTANT, leak_m3_per_s_pa=0.0)
    _, largest_pa = follow_sine(sealed)
    assert largest_pa == pytest.approx(168e5, rel=0.02)
