"""Figures derived from the parameters, and why eq. (8) cannot be taken literally."""

import numpy as np
import pytest

from plant_sim import PlantParameters, simulate
from plant_sim.derived import (
    effective_mass_kg,
    gravity_force_n,
    hydraulic_mode,
    input_gain_m_per_rad_s2,
    linearised,
    oil_stiffness_n_per_m,
    speed_gain_m_per_rad,
    state_space_coefficients,
)

P = PlantParameters()


def test_effective_mass_at_the_rod():
    masses = [effective_mass_kg(P, x) for x in np.linspace(0.0, 0.4, 81)]
    assert min(masses) == pytest.approx(888.0, rel=0.005)
    assert max(masses) == pytest.approx(1179.0, rel=0.001)


def test_hydraulic_mode():
    assert hydraulic_mode(P, 0.0).frequency_hz == pytest.approx(246.0, rel=0.005)
    assert hydraulic_mode(P, 0.15).frequency_hz == pytest.approx(23.0, rel=0.02)
    assert hydraulic_mode(P, 0.15).damping_ratio == pytest.approx(0.11, abs=0.005)


@pytest.mark.parametrize(("position_m", "gain"), [(0.0, 1490.0), (0.2, 11.9), (0.4, 799.0)])
def test_input_gain(position_m, gain):
    assert input_gain_m_per_rad_s2(P, position_m) == pytest.approx(gain, rel=0.01)


def test_speed_gain():
    assert speed_gain_m_per_rad(P) == pytest.approx(6.234e-4, rel=1e-4)


def test_speed_gain_is_what_the_plant_does_when_it_extends():
    sealed = PlantParameters(leak_m3_per_s_pa=0.0)
    assert simulate(np.full(3000, 100.0), parameters=sealed).velocity_m_s[-1] == pytest.approx(
        0.06234, rel=0.01
    )


@pytest.mark.parametrize("position_m", [0.1, 0.15, 0.2, 0.3])
def test_closed_form_mode_agrees_with_the_linearised_plant(position_m):
    poles = np.linalg.eigvals(linearised(P, position_m)[0])
    pole = poles[np.argmax(poles.imag)]
    mode = hydraulic_mode(P, position_m)
    assert abs(pole) / (2 * np.pi) == pytest.approx(mode.frequency_hz, rel=0.03)
    assert -pole.real / abs(pole) == pytest.approx(mode.damping_ratio, rel=0.03)


def test_the_plant_rings_at_the_hydraulic_mode():
    sealed = PlantParameters(leak_m3_per_s_pa=0.0)
    load_n = np.r_[0.0, np.full(999, -100.0)]
    trace = simulate(np.zeros(1000), load_n, parameters=sealed, initial_position_m=0.15)
    spectrum = np.abs(np.fft.rfft(trace.velocity_m_s))
    assert np.argmax(spectrum) == pytest.approx(23.0, abs=1.0)


def test_linearised_input_reaches_the_third_derivative_with_gain_b():
    a, b = linearised(P, 0.2)
    jerk = a[1] @ b
    assert jerk == pytest.approx(input_gain_m_per_rad_s2(P, 0.2))


def test_gravity_pushes_the_rod_in_all_along_the_stroke():
    assert all(gravity_force_n(P, x) > 400.0 for x in np.linspace(0.0, 0.4, 21))


@pytest.mark.parametrize("position_m", np.linspace(0.01, 0.39, 20))
def test_mended_state_space_has_the_speed_gain_of_the_pumps(position_m):
    k = state_space_coefficients(P, position_m)
    assert k.k1_per_s2 < 0.0
    assert 5.96e-4 < -k.k3_m_per_rad_s2 / k.k1_per_s2 < 6.24e-4


def literal_gain(volume_b):
    """-k3/k1 of eq. (8) as printed, where both are differences of the chambers' terms."""
    volume_a = P.dead_volume_a_m3 + P.piston_area_m2 * 0.2
    k1 = P.piston_area_m2**2 / volume_a - P.annulus_area_m2**2 / volume_b
    k3 = P.piston_area_m2 * P.pump_a_displacement_m3_per_rad / volume_a
    k3 -= P.annulus_area_m2 * P.pump_b_displacement_m3_per_rad / volume_b
    return P.volumetric_efficiency * k3 / k1


def test_literal_state_space_moves_13_percent_too_fast():
    growing_b = P.dead_volume_b_m3 + P.annulus_area_m2 * 0.2
    assert literal_gain(growing_b) == pytest.approx(7.04e-4, rel=0.005)


@pytest.mark.parametrize(
    ("position_m", "stable"), [(0.05, True), (0.225, True), (0.233, False), (0.35, False)]
)
def test_mending_only_eq_6_in_the_literal_state_space_makes_it_unstable_beyond_0_229_m(position_m, stable):
    stiffness_a, stiffness_b = oil_stiffness_n_per_m(P, position_m)
    literal_k1 = -(stiffness_a - stiffness_b) / effective_mass_kg(P, position_m)
    assert (literal_k1 < 0.0) is stable


def test_the_50_kg_of_table_2_would_ring_at_98_hz():
    stiffness = sum(oil_stiffness_n_per_m(P, 0.15))
    assert np.sqrt(stiffness / 50.0) / (2 * np.pi) == pytest.approx(98.0, rel=0.01)
