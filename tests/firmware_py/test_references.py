"""The built-in references are what their definitions say."""

import numpy as np
import pytest

from hil import references
from hil.scenario import load_scenario

PERIOD_S = 1e-3


def test_sine_is_eq_28():
    time_s = np.linspace(0, 10, 1001)
    expected = 0.15 * np.sin(0.2 * np.pi * time_s - np.pi / 2) + 0.15
    assert references.sine(time_s) == pytest.approx(expected, abs=1e-15)
    assert references.sine(np.array([0.0, 5.0, 10.0])) == pytest.approx([0.0, 0.3, 0.0], abs=1e-15)


def test_lift_lower_rests_where_its_moves_end():
    at_s = np.array([0.0, 0.3, 3.35, 4.79, 5.0, 6.15, 8.0, 9.2, 10.5])
    expected = [0, 0, 0.14, 0.14 - 0.10 * (1.39 - 0.1 / 0.75 / 2), 0, 0, 0.085, 0, 0]
    assert references.lift_lower(at_s) == pytest.approx(expected, abs=1e-12)


def test_lift_lower_slews_at_three_quarters_of_a_metre_per_second_squared():
    position = references.lift_lower(np.arange(10_500) * PERIOD_S)
    velocity = np.diff(position) / PERIOD_S
    acceleration = np.diff(velocity) / PERIOD_S
    assert velocity.max() == pytest.approx(0.05)
    assert velocity.min() == pytest.approx(-0.10)
    assert np.abs(acceleration).max() == pytest.approx(0.75, rel=1e-6)


def test_full_stroke_moves_smoothly_between_its_stations():
    assert references.full_stroke(np.array([0.0, 6.5, 8.0, 14.0])) == pytest.approx([0, 0.38, 0.33, 0.0003])
    assert references.full_stroke(np.array([3.3])) == pytest.approx([0.19])
    velocity = np.diff(references.full_stroke(np.arange(15_000) * PERIOD_S)) / PERIOD_S
    assert np.abs(velocity).max() == pytest.approx(1.875 * 0.38 / 6, rel=1e-3)


def test_loads_step_at_their_times():
    assert not load_scenario("sine").load_n().any()
    load_n = load_scenario("sine_load").load_n()
    assert load_n[2999] == 0.0
    assert load_n[3000] == -2000.0
    assert load_scenario("full_stroke").load_n()[7200] == -1500.0


def test_setpoints_are_rounded_to_a_tenth_of_a_micrometre():
    counts = references.setpoint_counts(np.array([0.0, 0.04e-6, 0.06e-6, 0.4]))
    assert counts.dtype == np.int32
    assert counts.tolist() == [0, 0, 1, 4_000_000]
