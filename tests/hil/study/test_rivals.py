"""The rivals keep their limit of robustness and nothing near them within it is better."""

import pytest

from firmware_py.tuning import LINEAR, PI_STAR, TUNINGS
from hil.study.rivals import MS_LIMIT, SEARCHES, limit_plants, limited_ms, optimise, sine_rms_mm

PLANTS = limit_plants()


def values_of(name):
    if name == "linear":
        return [LINEAR.omega_o_rad_s, LINEAR.omega_c_rad_s]
    return [23_400.0, 605_000.0]


@pytest.mark.parametrize("name", SEARCHES)
def test_no_neighbour_within_the_limit_is_clearly_better(name):
    values = values_of(name)
    best_mm = sine_rms_mm(SEARCHES[name].tuning(values))
    assert limited_ms(SEARCHES[name].tuning(values), PLANTS) <= MS_LIMIT
    for index in range(2):
        for factor in (0.96, 1.04):
            moved = list(values)
            moved[index] *= factor
            tuning = SEARCHES[name].tuning(moved)
            assert limited_ms(tuning, PLANTS) > MS_LIMIT or sine_rms_mm(tuning) > 0.99 * best_mm


def test_the_built_in_pi_star_uses_up_the_limit_and_is_not_the_best_within_it():
    assert limited_ms(TUNINGS["pi_star"], PLANTS) == pytest.approx(MS_LIMIT, abs=0.01)
    assert TUNINGS["pi_star"].pi == PI_STAR
    best = SEARCHES["pi_star"].tuning(values_of("pi_star"))
    assert sine_rms_mm(best) < 0.9 * sine_rms_mm(TUNINGS["pi_star"])


def test_linear_adrc_follows_the_sine_closer_than_the_papers():
    """It also uses up the limit, which the paper's tuning exceeds in its linear zone."""
    assert sine_rms_mm(TUNINGS["linear"]) < sine_rms_mm(TUNINGS["paper"])
    assert limited_ms(TUNINGS["paper"], PLANTS) == pytest.approx(2.09, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize("name", SEARCHES)
def test_the_search_finds_them(name):
    found = optimise(name)
    assert list(found.values())[:2] == pytest.approx(values_of(name), rel=0.02)
    assert found["ms"] <= MS_LIMIT + 1e-6
