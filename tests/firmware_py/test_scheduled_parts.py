"""Front end, schedule, command filter and observer of the laws with feed-forward, one by one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scheduled_in_floats import FloatScheduled

from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import command_filter, front_end, schedule
from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS, CommandFilterTuning, FrontEndTuning, PiTuning, Tuning

ROBUST = TUNINGS["robust"]
CALIBRATION = ROBUST.calibration().array()
PERIOD_S = 1e-3
M = 2.0**31
RAD_S = 2.0**20
RATIO = 2.0**24


def in_ints(calibration=CALIBRATION):
    """Calibration and an empty state as plain integers: the kernel's source runs on them as it stands."""
    return calibration.tolist(), [0] * k.ST_SIZE


# schedule


@pytest.mark.parametrize("position_m", [0.0, 0.0003, 0.02, 0.15, 0.2, 0.3, 0.37, 0.395, 0.4])
def test_stiffness_is_that_of_the_two_oil_columns(position_m):
    stiffness = schedule.stiffness(in_ints()[0], round(position_m * M)) / RATIO
    assert stiffness == pytest.approx(FloatScheduled(ROBUST, 0).stiffness(position_m), rel=2e-7)
    assert stiffness == pytest.approx(ROBUST.scheduled.stiffness(position_m), rel=2e-7)


def test_stiffness_is_one_at_the_reference_position():
    reference = round(ROBUST.scheduled.reference_m * M)
    assert schedule.stiffness(in_ints()[0], reference) / RATIO == pytest.approx(1.0, abs=2e-7)


@given(position=st.integers(-(2**31), 2**31 - 1))
def test_beyond_the_stroke_stiffness_is_that_of_its_end(position):
    words, _ = in_ints()
    stroke = words[k.CAL_STROKE]
    inside = min(max(position, 0), stroke)
    assert schedule.stiffness(words, position) == pytest.approx(schedule.stiffness(words, inside), abs=64)


@given(ratio=st.integers(1, 2**31 - 1))
def test_softness_is_the_reciprocal_or_the_largest_number(ratio):
    expected = min(2.0**48 / ratio, 2.0**31 - 1)
    assert schedule.softness(ratio) == pytest.approx(expected, abs=1.0)


def test_no_stiffness_is_all_softness():
    assert schedule.softness(0) == 2**31 - 1


# front end


def front_end_run(velocities_m_s, tuning=ROBUST):
    """Feed-forward (rad/s) for the limiter's velocities (m/s)."""
    words, state = in_ints(tuning.calibration().array())
    front_end.front_end_reset(state, 0)
    speeds = []
    for velocity in velocities_m_s:
        state[k.ST_LIMITER_RATE] = round(velocity * PERIOD_S * M)
        front_end.front_end_step(words, state, 0)
        speeds.append(front_end.feed_forward(words, state) / RAD_S)
    return np.array(speeds)


def test_a_steady_motion_gets_the_speed_of_its_direction():
    gains = ROBUST.front_end
    assert front_end_run([0.1] * 200)[-1] == pytest.approx(0.1 * gains.extend_rad_per_m, rel=1e-5)
    assert front_end_run([-0.1] * 200)[-1] == pytest.approx(-0.1 * gains.retract_rad_per_m, rel=1e-5)


def test_an_acceleration_is_led_by_the_lead_time():
    tuning = Tuning(front_end=FrontEndTuning(1500.0, 1500.0, lead_s=0.010, lead_filter_s=0.004))
    ramp_m_s = 0.5 * PERIOD_S * np.arange(200)
    assert front_end_run(ramp_m_s, tuning)[-1] / 1500 == pytest.approx(ramp_m_s[-1] + 0.5 * 0.010, rel=1e-4)


def test_without_lead_the_feed_forward_is_the_velocity_of_the_same_tick():
    tuning = Tuning(front_end=FrontEndTuning(1500.0, 1500.0, lead_s=0.0))
    velocities = [0.0, 0.05, -0.05, 0.02]
    assert front_end_run(velocities, tuning) == pytest.approx(1500 * np.array(velocities), abs=1e-3)


# command filter


@given(wanted=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=60))
def test_no_command_changes_faster_than_the_slew_or_winds_up_beyond_the_drives_speed(wanted):
    words, state = in_ints()
    slew, limit = words[k.CAL_COMMAND_SLEW], words[k.CAL_U_LIMIT]
    for value in wanted:
        last = state[k.ST_COMMAND]
        sent = command_filter.command_filter_step(words, state, value)
        assert abs(sent - last) <= slew
        assert abs(state[k.ST_COMMAND]) <= limit


def test_a_small_step_passes_as_through_a_first_order_lag():
    filtered = CommandFilterTuning(time_constant_s=5e-3, slew_rad_s2=1e6)
    words, state = in_ints(Tuning(command_filter=filtered).calibration().array())
    response = [command_filter.command_filter_step(words, state, round(10 * RAD_S)) for _ in range(20)]
    expected = 10 * (1 - np.exp(-np.arange(1, 21) / 5))
    assert np.array(response) / RAD_S == pytest.approx(expected, abs=1e-4)


def test_a_time_constant_of_zero_is_no_low_pass():
    tuning = Tuning(command_filter=CommandFilterTuning(time_constant_s=0.0, slew_rad_s2=1e6))
    words, state = in_ints(tuning.calibration().array())
    assert command_filter.command_filter_step(words, state, 12_345_678) == 12_345_678


# the laws as a whole


class Bench:
    """The compiled kernel in SI units."""

    def __init__(self, tuning, position_m=0.1):
        self.calibration = tuning.calibration().array()
        self.state = np.zeros(k.ST_SIZE, np.int32)
        self.io = np.zeros(k.IO_SIZE, np.int32)
        self.io[k.IO_LAW] = tuning.law
        self.io[k.IO_POSITION] = round(position_m * 1e6)
        control_reset(self.calibration, self.state, self.io)

    def step(self, setpoint_m, position_m):
        self.io[k.IO_SETPOINT] = round(setpoint_m * 1e7)
        self.io[k.IO_POSITION] = round(position_m * 1e6)
        control_step(self.calibration, self.state, self.io)
        return self.io[k.IO_TARGET_VELOCITY] * math.pi / 120


@pytest.mark.parametrize("name", ["robust", "pi_ff"])
@pytest.mark.parametrize("position_m", [0.0, 0.123456, 0.4])
def test_reset_is_bumpless_at_the_measured_position(name, position_m):
    bench = Bench(TUNINGS[name], position_m)
    for _ in range(100):
        assert bench.step(position_m, position_m) == 0.0
    assert bench.io[k.IO_FLAGS] == 0


def test_the_observer_is_fed_the_command_that_was_sent_through_the_motors_model():
    bench = Bench(ROBUST, 0.2)
    motor, sent = 0.0, 0.0
    share = 1 - math.exp(-PERIOD_S / ROBUST.scheduled.motor_time_constant_s)
    for tick in range(100):
        motor += share * (sent - motor)
        sent = bench.step(0.2 + 1e-4 * tick, 0.2)
        assert bench.state[k.ST_MOTOR] / RAD_S == pytest.approx(motor, abs=1e-3)
    assert sent > 10.0


def test_z4_is_the_disturbance_times_the_scheduled_b0():
    bench = Bench(ROBUST, 0.03)
    for _ in range(200):
        bench.step(0.032, 0.03)
    b0 = ROBUST.scheduled.b0_m_s2_per_rad * ROBUST.scheduled.stiffness(0.03)
    w = bench.state[k.ST_DISTURBANCE] / RAD_S
    assert abs(w) > 1.0
    assert bench.state[k.ST_Z4] * 2.0**-42 / PERIOD_S**3 == pytest.approx(b0 * w, rel=1e-3)


def test_pi_with_feed_forward_is_pi_plus_the_feed_forward():
    plain = CommandFilterTuning(time_constant_s=0.0, slew_rad_s2=1e6)
    front = FrontEndTuning(1500.0, 1500.0, lead_s=0.0)
    gains = PiTuning(10_000.0, 50_000.0)
    forward = Bench(Tuning(law=k.LAW_PI_FF, pi=gains, command_filter=plain, front_end=front))
    pi = Bench(Tuning(law=k.LAW_PI, pi=gains))
    for tick in range(500):
        setpoint_m, position_m = 0.1 + 0.05e-3 * max(0, tick - 100), 0.1 + 0.045e-3 * max(0, tick - 100)
        difference = forward.step(setpoint_m, position_m) - pi.step(setpoint_m, position_m)
    assert difference == pytest.approx(0.05 * 1500.0, abs=0.03)


def test_a_change_of_law_forgets_disturbance_and_command():
    bench = Bench(ROBUST, 0.2)
    for _ in range(300):
        bench.step(0.21, 0.2)
    assert bench.state[k.ST_DISTURBANCE] != 0
    bench.io[k.IO_LAW] = k.LAW_P
    bench.step(0.2, 0.2)
    assert bench.state[k.ST_DISTURBANCE] == bench.state[k.ST_COMMAND] == bench.state[k.ST_MOTOR] == 0
