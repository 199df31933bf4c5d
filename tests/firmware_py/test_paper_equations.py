"""Why the controller's equations (18), (24), (26), (27) cannot be taken as printed."""

import math

import adrc_in_floats
import numpy as np
import pytest
from adrc_in_floats import PERIOD_S, FloatAdrc, fhan
from kernel_runs import CASES, step_through

from firmware_py.tuning import ADRC, AdrcTuning
from plant_sim.derived import state_space_coefficients
from plant_sim.parameters import PlantParameters

SINE = CASES["sine"]


def sine_rms_mm(controller, tuning=ADRC):
    positions_m = step_through(SINE, lambda position_um: controller(tuning, position_um).step)
    return float(np.sqrt(np.mean((SINE.setpoint * 1e-7 - positions_m) ** 2))) * 1e3


def plain_fal(e, alpha, delta):
    """Han's fal: |e|^alpha outside, a straight line inside +-delta; not normalised."""
    return e / delta ** (1 - alpha) if abs(e) <= delta else math.copysign(abs(e) ** alpha, e)


def test_the_mended_equations_follow_the_sine():
    assert sine_rms_mm(FloatAdrc) < 0.06


def test_without_the_reference_in_eq_18_the_differentiator_goes_to_zero():
    """(18) prints fh = fhan(x1, x2, r, h): nothing in it knows the setpoint."""
    v1, v2 = 0.2, 0.0
    for _ in range(1000):
        v1, v2 = v1 + PERIOD_S * v2, v2 + PERIOD_S * fhan(v1, v2, ADRC.r0_m_s2, ADRC.h0_s)
    assert v1 == pytest.approx(0.0, abs=1e-6)


def test_the_total_disturbance_of_eq_24_is_what_the_nominal_model_misses():
    """With k̃ = nominal - actual, all three terms are subtracted; (24) prints + k̃1 x2."""
    nominal = state_space_coefficients(PlantParameters(), 0.2)
    actual = state_space_coefficients(PlantParameters().scaled(bulk_modulus=0.5, mass=1.3), 0.2)
    x2, x3, omega, f = 0.05, 0.7, 80.0, -3.0
    jerk = actual.k1_per_s2 * x2 + actual.k2_per_s * x3 + actual.k3_m_per_rad_s2 * omega + f
    modelled = nominal.k1_per_s2 * x2 + nominal.k2_per_s * x3 + nominal.k3_m_per_rad_s2 * omega
    k1, k2 = nominal.k1_per_s2 - actual.k1_per_s2, nominal.k2_per_s - actual.k2_per_s
    k3 = nominal.k3_m_per_rad_s2 - actual.k3_m_per_rad_s2
    assert modelled - k1 * x2 - k2 * x3 - k3 * omega + f == pytest.approx(jerk)
    assert modelled + k1 * x2 - k2 * x3 - k3 * omega + f != pytest.approx(jerk, rel=0.1)


def test_eq_26_without_a_linear_zone_throws_the_rod_about(monkeypatch):
    """|e|^(1/4) has no slope limit at zero: the observer's last two lines act like relays."""

    def printed(e, alpha, delta):
        return math.copysign(abs(e) ** alpha, e) if alpha < 0.5 else normalised(e, alpha, delta)

    normalised = adrc_in_floats.fal
    monkeypatch.setattr(adrc_in_floats, "fal", printed)
    assert sine_rms_mm(FloatAdrc) > 100.0


@pytest.mark.parametrize("delta_m", [1e-4, 1e-3, 1e-2, 0.05])
def test_plain_fal_with_bandwidth_gains_in_metres_is_unstable(delta_m, monkeypatch):
    """Its slope within the zone is delta^(alpha - 1), 10 to 3000: that multiplies the bandwidth's gains."""

    def plain(e, alpha, delta):
        return plain_fal(e, alpha, delta) if alpha < 0.5 else normalised(e, alpha, delta)

    normalised = adrc_in_floats.fal
    monkeypatch.setattr(adrc_in_floats, "fal", plain)
    assert sine_rms_mm(FloatAdrc, AdrcTuning(eso_delta_m=delta_m)) > 100.0


class MixedUnits(FloatAdrc):
    """u = u0 - z4 / b0 of (27): m/s³ less rad/s."""

    def _feedback(self):
        b0, a1n, z2, z4 = self.tuning.b0_m_s2_per_rad, self.tuning.a1n_per_s2, self.z[1], self.z[3]
        u0 = super()._feedback() * b0 + z4 + a1n * z2
        return u0 - z4 / b0


def test_eq_27_as_printed_commands_a_jerk_as_if_it_were_a_speed():
    assert sine_rms_mm(MixedUnits) > 10.0


class ModelLeftIn(FloatAdrc):
    """The observer's a1n z2 is not cancelled in u."""

    def _feedback(self):
        return super()._feedback() + self.tuning.a1n_per_s2 * self.z[1] / self.tuning.b0_m_s2_per_rad


def test_a_model_in_the_observer_has_to_be_cancelled_in_the_feedback():
    assert sine_rms_mm(ModelLeftIn) > 5 * sine_rms_mm(FloatAdrc)
