"""What each law does in a tick, seen through the kernel's entry points."""

import math

import numpy as np
import pytest
from adrc_in_floats import FloatAdrc

from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.tuning import PI_STAR, AdrcTuning, LimiterTuning, PiTuning, Tuning

RAD_S_PER_COUNT = math.pi / 120
FAST_LIMITER = LimiterTuning(speed_m_s=7.5, acceleration_m_s2=7500.0)


class Bench:
    """The compiled kernel in SI units, to be made with a limiter that passes steps of 7 mm."""

    def __init__(self, tuning: Tuning, position_m: float = 0.1) -> None:
        self.calibration = tuning.calibration().array()
        self.state = np.zeros(k.ST_SIZE, np.int32)
        self.io = np.zeros(k.IO_SIZE, np.int32)
        self.io[k.IO_LAW] = tuning.law
        self.io[k.IO_POSITION] = round(position_m * 1e6)
        control_reset(self.calibration, self.state, self.io)

    def step(self, setpoint_m: float, position_m: float) -> float:
        """Return the commanded speed in rad/s."""
        self.io[k.IO_SETPOINT] = round(setpoint_m * 1e7)
        self.io[k.IO_POSITION] = round(position_m * 1e6)
        control_step(self.calibration, self.state, self.io)
        return self.io[k.IO_TARGET_VELOCITY] * RAD_S_PER_COUNT


@pytest.mark.parametrize("law", [k.LAW_P, k.LAW_PI, k.LAW_ADRC])
@pytest.mark.parametrize("position_m", [0.0, 0.123456, 0.4])
def test_reset_is_bumpless_at_the_measured_position(law, position_m):
    bench = Bench(Tuning(law=law), position_m)
    for _ in range(100):
        assert bench.step(position_m, position_m) == 0.0
    assert bench.io[k.IO_FLAGS] == 0
    assert bench.state[k.ST_Z1] == bench.state[k.ST_V1] == bench.state[k.ST_LIMITER_POSITION]


def test_p_commands_its_gain_times_the_error_quantised_to_a_quarter_rpm():
    bench = Bench(Tuning(law=k.LAW_P, limiter=FAST_LIMITER))
    assert bench.step(0.105, 0.1) == pytest.approx(31_100 * 0.005, abs=RAD_S_PER_COUNT / 2)
    assert bench.step(0.105, 0.107) == pytest.approx(-31_100 * 0.002, abs=RAD_S_PER_COUNT / 2)


def test_pi_adds_the_integral_of_the_error():
    bench = Bench(Tuning(law=k.LAW_PI, limiter=FAST_LIMITER))
    for tick in range(1, 101):
        command = bench.step(0.101, 0.1)
        expected = 27_270 * 0.001 + 39_900 * 0.001 * 1e-3 * tick
        assert command == pytest.approx(expected, abs=RAD_S_PER_COUNT / 2 + 1e-4)


def test_the_command_is_clipped_to_the_drives_speed_exactly():
    bench = Bench(Tuning(law=k.LAW_P, speed_limit_rpm=1500.0, limiter=FAST_LIMITER))
    at_limit_m = 50 * math.pi / 31_100  # 5.0508 mm
    bench.step(0.1 + at_limit_m - 1e-5, 0.1)
    assert bench.io[k.IO_TARGET_VELOCITY] < 6000
    assert bench.io[k.IO_FLAGS] & k.FLAG_SPEED_LIMITED == 0
    bench.step(0.1 + at_limit_m + 1e-5, 0.1)
    assert bench.io[k.IO_TARGET_VELOCITY] == 6000
    assert bench.io[k.IO_FLAGS] & k.FLAG_SPEED_LIMITED
    bench.step(0.1, 0.1 + at_limit_m + 1e-5)
    assert bench.io[k.IO_TARGET_VELOCITY] == -6000


def test_a_speed_limit_between_two_quarter_rpm_is_rounded_down():
    bench = Bench(Tuning(law=k.LAW_P, speed_limit_rpm=1000.2, limiter=FAST_LIMITER))
    bench.step(0.105, 0.1)
    assert bench.io[k.IO_TARGET_VELOCITY] == 4000


@pytest.mark.parametrize("direction", [1, -1])
def test_the_integral_does_not_wind_up_while_the_drive_is_at_its_limit(direction):
    bench = Bench(Tuning(law=k.LAW_PI, pi=PI_STAR, speed_limit_rpm=600.0, limiter=FAST_LIMITER), 0.2)
    limit_rad_s = 20 * math.pi
    for _ in range(2000):  # a blocked rod: 2 mm of error for 2 s would integrate to 2 053 rad/s
        command = bench.step(0.2 + direction * 0.002, 0.2)
    assert command == pytest.approx(direction * limit_rad_s)
    integral = bench.state[k.ST_INTEGRAL] * 2.0**-20
    assert 0 < integral * direction <= limit_rad_s - 20_853 * 0.002 + 513_300 * 0.002 * 1e-3
    # and it turns round as soon as the error does
    assert bench.step(0.2, 0.2 + direction * 0.002) * direction < 0


def test_the_integral_still_unwinds_at_the_limit():
    tuning = Tuning(law=k.LAW_PI, pi=PiTuning(1000.0, 2e6), speed_limit_rpm=600.0, limiter=FAST_LIMITER)
    bench = Bench(tuning, 0.2)
    for _ in range(50):
        bench.step(0.201, 0.2)
    wound = bench.state[k.ST_INTEGRAL]
    bench.step(0.2, 0.2001)
    assert 0 < bench.state[k.ST_INTEGRAL] < wound


def test_adrc_feeds_the_observer_the_command_it_sent_clipped_and_quantised():
    bench = Bench(Tuning(speed_limit_rpm=600.0, limiter=FAST_LIMITER), 0.2)
    command = bench.step(0.205, 0.2)
    bench.step(0.205, 0.2)
    command = bench.step(0.205, 0.2)
    assert command == pytest.approx(20 * math.pi)
    assert bench.state[k.ST_U] * 2.0**-20 == pytest.approx(command, abs=2.0**-20)


def test_the_differentiator_leads_its_lag_away_on_a_ramp():
    bench = Bench(Tuning(), 0.1)
    for tick in range(2000):
        setpoint_m = 0.1 + 0.05 * max(tick - 100, 0) * 1e-3
        bench.step(setpoint_m, setpoint_m)
    v1 = bench.state[k.ST_V1] * 2.0**-31
    v2 = bench.state[k.ST_V2] * 2.0**-38 / 1e-3
    assert v2 == pytest.approx(0.05, rel=1e-5)
    # v1 is a value for k+1, hence the period
    assert v1 + 0.010 * v2 == pytest.approx(setpoint_m + 0.05e-3, abs=1e-7)


@pytest.mark.parametrize("a2n_per_s", [0.0, -100.0, 100.0])
def test_observer_and_command_follow_the_float_reference_also_with_a2n(a2n_per_s):
    adrc = AdrcTuning(a2n_per_s=a2n_per_s)
    bench, floats = Bench(Tuning(adrc=adrc)), FloatAdrc(adrc, 100_000)
    for tick in range(100):
        setpoint, position_um = 1_000_000 + 4 * tick**2, 100_000 + tick**2 // 3
        command = bench.step(setpoint * 1e-7, position_um * 1e-6)
        assert command == pytest.approx(floats.step(setpoint, position_um) * RAD_S_PER_COUNT, abs=0.06)
    scales = (2.0**-31, 2.0**-38 / 1e-3, 2.0**-40 / 1e-6, 2.0**-42 / 1e-9)
    observed = [bench.state[k.ST_Z1 + n] * scale for n, scale in enumerate(scales)]
    assert observed == pytest.approx(floats.z, rel=1e-3)


def test_an_unknown_law_commands_standstill():
    bench = Bench(Tuning(law=k.LAW_P, limiter=FAST_LIMITER))
    assert bench.step(0.105, 0.1) > 0
    bench.io[k.IO_LAW] = 9
    assert bench.step(0.105, 0.1) == 0.0


def test_a_change_of_law_starts_the_new_one_at_the_measured_position():
    bench = Bench(Tuning(law=k.LAW_PI, limiter=FAST_LIMITER))
    for _ in range(100):
        bench.step(0.101, 0.1)
    bench.io[k.IO_LAW] = k.LAW_ADRC
    bench.step(0.1, 0.1)
    assert bench.state[k.ST_INTEGRAL] == 0
    assert abs(bench.state[k.ST_Z1] * 2.0**-31 - 0.1) < 1e-4


def test_an_impossible_position_saturates_the_states_and_says_so():
    bench = Bench(Tuning(), 0.2)
    bench.step(0.2, -1000.0)
    assert bench.io[k.IO_FLAGS] & k.FLAG_STATE_SATURATED
    bench.step(0.2, -1000.0)
    assert bench.io[k.IO_SATURATIONS] == bench.state[k.ST_SATURATIONS] > 0
    control_reset(bench.calibration, bench.state, bench.io)
    assert bench.io[k.IO_SATURATIONS] == 0
