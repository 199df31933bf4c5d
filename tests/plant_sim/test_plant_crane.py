"""Geometry and inertia of the crane, eqs 9-17."""

from math import acos, cos

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_sim import PlantParameters, advance, initial_state, simulate
from plant_sim import layout as at
from plant_sim.crane import end_stop, geometry, rod_dynamics
from plant_sim.hydraulics import chamber_volumes

P = PlantParameters()
VECTOR = P.vector()
STROKE = st.floats(0.0, P.stroke_m)


def gamma_rad(x):
    d1, d2, x_t = P.boom_length_d1_m, P.mast_length_d2_m, P.retracted_length_m + x
    return acos((d1**2 + d2**2 - x_t**2) / (2 * d1 * d2))


def moments():
    return (
        (P.arm_1_mass_kg * P.arm_1_radius_m, P.arm_1_angle_rad),
        (P.arm_2_mass_kg * P.arm_2_radius_m, P.arm_2_angle_rad),
        (P.load_mass_kg * P.load_radius_m, P.load_angle_rad),
    )


def potential_j(x, pairs=None):
    turned = gamma_rad(x) - gamma_rad(0.0)
    return -9.81 * sum(moment * cos(angle + turned) for moment, angle in pairs or moments())


def slope(function, x, step=1e-5):
    return (function(x + step) - function(x - step)) / (2.0 * step)


@given(STROKE)
def test_cosine_rule_closes_the_triangle(x):
    cos_gamma, sin_gamma, _, _ = geometry(x, VECTOR)
    assert cos_gamma == pytest.approx(cos(gamma_rad(x)), abs=1e-12)
    assert cos_gamma**2 + sin_gamma**2 == pytest.approx(1.0)


@given(STROKE)
def test_lever_is_the_slope_of_length_over_angle(x):
    _, _, lever, _ = geometry(x, VECTOR)
    assert 1.0 / lever == pytest.approx(slope(gamma_rad, x), rel=1e-7)


@given(STROKE)
def test_lever_is_d1_sin_alpha_of_the_sine_rule(x):
    _, sin_gamma, lever, _ = geometry(x, VECTOR)
    sin_alpha = P.mast_length_d2_m / (P.retracted_length_m + x) * sin_gamma
    assert lever == pytest.approx(P.boom_length_d1_m * sin_alpha)


@given(STROKE)
def test_lever_slope_is_taken_over_the_angle(x):
    _, _, lever, lever_slope = geometry(x, VECTOR)
    assert lever_slope == pytest.approx(
        slope(lambda y: geometry(y, VECTOR)[2], x) * lever, rel=1e-6, abs=1e-8
    )


@given(STROKE)
def test_gravity_at_the_rod_is_the_slope_of_potential_energy(x):
    _, gravity_n, _ = rod_dynamics(x, VECTOR)
    assert gravity_n == pytest.approx(slope(potential_j, x), rel=1e-7)


def test_gravity_without_the_loads_lever_arm_breaks_energy_conservation():
    """Eq. (10) prints m_load sin θ without r_load: a force among torques, a quarter short."""
    literal = (*moments()[:2], (P.load_mass_kg, P.load_angle_rad))
    x = 0.2
    _, gravity_n, _ = rod_dynamics(x, VECTOR)
    assert slope(lambda y: potential_j(y, literal), x) / gravity_n == pytest.approx(0.73, abs=0.01)


@given(STROKE)
def test_centripetal_term_is_the_change_of_kinetic_energy_with_position(x):
    """Lagrange: m v̇ = F - ½ m'(x) v²."""
    _, _, centripetal = rod_dynamics(x, VECTOR)
    assert centripetal == pytest.approx(
        -0.5 * slope(lambda y: rod_dynamics(y, VECTOR)[0], x), rel=1e-5, abs=1e-3
    )


def test_stops_push_back_only_beyond_the_stroke_and_never_pull():
    assert end_stop(0.1, -1.0, VECTOR)[0] == 0.0
    assert end_stop(-1e-5, 0.0, VECTOR)[0] == pytest.approx(1000.0)
    assert end_stop(-1e-5, -0.1, VECTOR)[0] == pytest.approx(3000.0)
    assert end_stop(-1e-5, 0.1, VECTOR)[0] == 0.0
    assert end_stop(P.stroke_m + 1e-5, 0.1, VECTOR)[0] == pytest.approx(-3000.0)
    assert end_stop(P.stroke_m + 1e-5, -0.1, VECTOR)[0] == 0.0


@pytest.mark.parametrize("x", [-2e-5, P.stroke_m + 2e-5])
@pytest.mark.parametrize("v", [-0.03, 0.03])
def test_stop_slopes_are_its_derivatives(x, v):
    _, position_slope, velocity_slope = end_stop(x, v, VECTOR)
    assert position_slope == pytest.approx(slope(lambda y: end_stop(y, v, VECTOR)[0], x, 1e-8), rel=1e-6)
    assert velocity_slope == pytest.approx(slope(lambda u: end_stop(x, u, VECTOR)[0], v, 1e-6), rel=1e-6)


def test_without_friction_and_leak_a_bouncing_load_keeps_its_energy():
    parameters = PlantParameters(damping_n_s_per_m=0.0, leak_m3_per_s_pa=0.0)
    p = parameters.vector()
    start = initial_state(parameters, 0.2)
    load_n = -150.0
    state = start.copy()

    def oil_energy_j(volume, volume_0, pressure_0):
        beta = parameters.bulk_modulus_pa
        growth = volume - volume_0
        return -pressure_0 * growth + beta * (volume * np.log(volume / volume_0) - growth)

    def energy_j(s):
        x, v = s[at.POSITION], s[at.VELOCITY]
        volumes, volumes_0 = chamber_volumes(x, p), chamber_volumes(0.2, p)
        oil = oil_energy_j(volumes[0], volumes_0[0], start[at.PRESSURE_A])
        oil += oil_energy_j(volumes[1], volumes_0[1], start[at.PRESSURE_B])
        outside_n = load_n + parameters.atmosphere_pa * parameters.rod_area_m2
        return 0.5 * rod_dynamics(x, p)[0] * v**2 + potential_j(x) + oil + outside_n * (x - 0.2)

    speeds, energies = [], []
    for _ in range(1000):
        advance(state, p, 0.0, load_n, 1e-3, 10)
        speeds.append(state[at.VELOCITY])
        energies.append(energy_j(state))
    bounce_j = 0.5 * rod_dynamics(0.2, p)[0] * max(speeds) ** 2
    assert bounce_j > 1e-4
    assert np.ptp(energies) < 0.002 * bounce_j


def test_a_load_that_pulls_the_rod_out_extends_it():
    still = simulate(np.zeros(300), 0.0, initial_position_m=0.2)
    pulled = simulate(np.zeros(300), -2000.0, initial_position_m=0.2)
    assert pulled.position_m[-1] > still.position_m[-1]
