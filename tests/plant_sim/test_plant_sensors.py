"""What the sensors report."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_sim import PositionSensor, pressure_count


def test_position_is_reported_in_micrometres_rounded_to_the_nearest():
    sensor = PositionSensor()
    assert [sensor.read(x) for x in (0.0, 0.4e-6, 0.6e-6, 0.123456, -2.93e-6)] == [0, 0, 1, 123456, -3]


def test_a_coarse_sensor_still_reports_micrometres():
    assert PositionSensor(lsb_m=10e-6).read(0.123456) == 123460


@given(st.floats(-0.01, 0.41), st.integers(1, 1000))
def test_quantisation_error_is_at_most_half_a_step(position_m, lsb_um):
    count = PositionSensor(lsb_m=lsb_um * 1e-6).read(position_m)
    assert count % lsb_um == 0
    assert abs(count - position_m * 1e6) <= 0.5 * lsb_um + 1e-6


def test_position_saturates_at_32_bits():
    assert PositionSensor().read(1e4) == 2**31 - 1
    assert PositionSensor().read(-1e4) == -(2**31)


def test_noise_has_the_given_strength_and_repeats_with_its_seed():
    counts = [PositionSensor(noise_rms_m=20e-6, seed=7).read(0.1) for _ in range(2)]
    sensor = PositionSensor(noise_rms_m=20e-6, seed=7)
    samples = [sensor.read(0.1) for _ in range(4000)]
    assert counts[0] == counts[1] == samples[0]
    assert np.std(samples) == pytest.approx(20.0, rel=0.05)
    assert np.mean(samples) == pytest.approx(100_000.0, abs=2.0)


@pytest.mark.parametrize("lsb_m", [0.0, -1e-6, 0.5e-6, 1.5e-6, float("nan"), float("inf")])
def test_resolution_must_be_whole_micrometres(lsb_m):
    with pytest.raises(ValueError, match=r"^lsb_m is "):
        PositionSensor(lsb_m=lsb_m)


@pytest.mark.parametrize("noise_rms_m", [-1e-6, float("nan"), float("inf")])
def test_noise_must_not_be_negative(noise_rms_m):
    with pytest.raises(ValueError, match=r"^noise_rms_m is "):
        PositionSensor(noise_rms_m=noise_rms_m)


def test_pressure_is_reported_in_hundredths_of_a_bar_and_saturates():
    assert [pressure_count(p) for p in (0.0, 3.5e5, 3.5049e5, 655.35e5, 1e8, -1e5)] == [
        0,
        350,
        350,
        65535,
        65535,
        0,
    ]
