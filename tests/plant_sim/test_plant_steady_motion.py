"""What a motor that holds or moves the rod settles to, and the plant linearised about it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from plant_sim import PlantParameters, advance
from plant_sim import layout as at
from plant_sim.derived import linearised_about, steady_motion
from plant_sim.hydraulics import accumulator_pressure

P = PlantParameters()
SCALES = np.array([1e-6, 1e-4, 10.0, 10.0, 1e-2])  # of x, v, p_A, p_B, ω: small, and large against rounding


@settings(max_examples=30, deadline=None)
@given(
    position_m=st.floats(3e-4, 0.395),
    mass=st.floats(0.5, 1.5),
    leak=st.floats(0.5, 2.5),
    load_n=st.floats(-2000.0, 2000.0),
)
def test_held_by_its_motor_the_rod_rests_for_good(position_m, mass, leak, load_n):
    parameters = P.scaled(mass=mass, leak=leak)
    motion = steady_motion(parameters, position_m, load_n=load_n)
    state = motion.state.copy()
    for _ in range(1000):
        advance(state, parameters.vector(), motion.state[at.MOTOR_SPEED], load_n, 1e-3, 10)
    assert state[at.POSITION] == pytest.approx(position_m, abs=1e-9)
    assert state[[at.PRESSURE_A, at.PRESSURE_B]] == pytest.approx(
        motion.state[[at.PRESSURE_A, at.PRESSURE_B]], rel=1e-6
    )


@pytest.mark.parametrize("velocity_m_s", [-0.1, -0.01, 0.01, 0.1])
def test_a_steady_motion_goes_on(velocity_m_s):
    motion = steady_motion(P, 0.2, velocity_m_s)
    state = motion.state.copy()
    for _ in range(20):
        advance(state, P.vector(), motion.state[at.MOTOR_SPEED], 0.0, 1e-3, 10)
    assert state[at.POSITION] == pytest.approx(0.2 + 0.02 * velocity_m_s, rel=1e-4)
    assert state[at.VELOCITY] == pytest.approx(velocity_m_s, rel=2e-3)


@pytest.mark.parametrize("velocity_m_s", [-0.1, 0.0, 0.1])
def test_in_steady_motion_the_rod_sides_check_valve_conducts(velocity_m_s):
    motion = steady_motion(P, 0.2, velocity_m_s)
    line_pa = accumulator_pressure(motion.state[at.OIL_VOLUME], P.vector())
    assert motion.state[at.PRESSURE_B] < line_pa - P.check_valve_crack_pa
    assert motion.inflow_slopes[1] == pytest.approx(-P.check_valve_gain_m3_per_s_pa, rel=0.1)


def test_the_pumps_gain_is_eta_while_they_lift_and_two_minus_eta_while_they_lower():
    per_rad = P.pump_a_displacement_m3_per_rad
    assert steady_motion(P, 0.2, 0.1).inflow_gains[0] == pytest.approx(0.85 * per_rad)
    assert steady_motion(P, 0.2, -0.1).inflow_gains[0] == pytest.approx(1.15 * per_rad)


@pytest.mark.parametrize("velocity_m_s", [0.0, -0.1, 0.1])
@pytest.mark.parametrize("position_m", [3e-3, 0.15, 0.395])
def test_linearised_plant_is_the_integrators_derivative(position_m, velocity_m_s):
    """Ten microseconds of the integrator, by central differences, against the matrix exponential of a, b."""
    motion = steady_motion(P, position_m, velocity_m_s)
    a, b = linearised_about(P, motion)
    p, dt_s = P.vector(), 1e-5
    order = [at.POSITION, at.VELOCITY, at.PRESSURE_A, at.PRESSURE_B, at.MOTOR_SPEED]

    def after(disturbance):
        state = motion.state.copy()
        state[order] += disturbance
        advance(state, p, state[at.MOTOR_SPEED], 0.0, dt_s, 100)
        return state[order]

    measured = np.column_stack([(after(step) - after(-step)) / 2.0 for step in np.diag(SCALES)])
    expected = expm(np.vstack([np.column_stack([a, b]), np.zeros(5)]) * dt_s) * SCALES
    row_scale = np.abs(expected).max(axis=1, keepdims=True)
    assert measured / row_scale == pytest.approx(expected / row_scale, abs=2e-3)


def test_what_the_motor_cannot_give_is_refused():
    with pytest.raises(ValueError, match="beyond what the motor gives"):
        steady_motion(P, 0.2, 1.0)
    with pytest.raises(ValueError, match="without a leak"):
        steady_motion(PlantParameters(leak_m3_per_s_pa=0.0), 0.2)
    with pytest.raises(ValueError, match="position_m is"):
        steady_motion(P, 0.5)
