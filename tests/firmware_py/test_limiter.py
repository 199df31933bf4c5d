"""The setpoint limiter: transparent within its limits, bounded and without overshoot beyond them."""

import math

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import firmware_py.compiled  # noqa: F401  (makes the kernel callable from jitted code)
from firmware_py.kernel import layout as k
from firmware_py.kernel import limiter, units
from firmware_py.tuning import Tuning
from hil import references

CALIBRATION = Tuning().calibration().array()
LSB_UM = 1e6 / 2**31
PERIOD_S = 1e-3


@numba.njit
def _run(calibration, start, setpoints, limited):
    state = np.zeros(k.ST_SIZE, np.int32)
    limiter.limiter_reset(state, start)
    for tick in range(setpoints.size):
        limited[tick] = limiter.limiter_step(calibration, state, setpoints[tick])


def to_kernel(counts) -> np.ndarray:
    """Setpoints of 0.1 um in 2^-31 m."""
    return np.array([units.metres_from_setpoint(int(count)) for count in counts], np.int32)


def limit(setpoints: np.ndarray, start: int = 0) -> np.ndarray:
    """Limited setpoints, 2^-31 m, from rest at `start`."""
    limited = np.empty(setpoints.size, np.int32)
    _run(CALIBRATION, np.int32(start), setpoints, limited)
    return limited.astype(np.int64)


@pytest.mark.parametrize("reference", references.REFERENCES)
def test_a_built_in_reference_passes_bit_for_bit(reference):
    time_s = np.arange(15_000) * PERIOD_S
    setpoints = to_kernel(references.setpoint_counts(references.REFERENCES[reference](time_s)))
    assert np.array_equal(limit(setpoints, setpoints[0]), setpoints)


@given(
    accelerations=st.lists(st.floats(-1.0, 1.0) | st.sampled_from([-1.0, 1.0]), min_size=1, max_size=20),
    hold=st.integers(1, 300),
    phase=st.floats(0, 1),
)
@example(accelerations=[1.0, -1.0] * 10, hold=140, phase=0.5)
@example(accelerations=[1.0, 0.0, -1.0, -1.0, 0.0, 1.0], hold=140, phase=0.123)
def test_any_sampled_rounded_reference_within_the_limits_passes_bit_for_bit(accelerations, hold, phase):
    position, velocity, positions = phase * 1e-7, 0.0, []
    for acceleration in np.repeat(accelerations, hold):
        reached = min(max(velocity + acceleration * PERIOD_S, -0.14), 0.14)
        position += (velocity + reached) / 2 * PERIOD_S
        velocity = reached
        positions.append(position)
    setpoints = to_kernel(np.rint(np.array(positions) / 1e-7))
    assert np.array_equal(limit(setpoints), setpoints)


@given(
    jumps=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=20),
    start=st.integers(-(2**31), 2**31 - 1),
)
def test_whatever_the_setpoint_velocity_and_acceleration_stay_limited(jumps, start):
    limited = limit(np.repeat(np.array(jumps, np.int32), 50), start)
    increments = np.diff(limited, prepend=start)
    assert np.abs(increments).max() <= CALIBRATION[k.CAL_LIMITER_RATE]
    within_range = np.abs(limited[1:]) < 2**31 - 1
    changes = np.diff(increments)[within_range]
    assert np.abs(changes).max(initial=0) <= CALIBRATION[k.CAL_LIMITER_SLEW]


@settings(max_examples=60)
@given(step_um=st.integers(-400_000, 400_000))
@example(step_um=50_000)
@example(step_um=1)
def test_a_step_arrives_without_overshoot_in_the_time_the_limits_allow(step_um):
    setpoints = to_kernel([step_um * 10] * 4000)
    target = int(setpoints[0])
    limited = limit(setpoints)
    overshoot_um = ((limited - target) * np.sign(target)).max() * LSB_UM
    assert overshoot_um <= 0.1
    arrival = int(np.argmax(limited == target))
    assert np.all(limited[arrival:] == target)
    step_m = abs(step_um) * 1e-6
    accelerating_s = min(0.14, math.sqrt(step_m))
    shortest_s = step_m / accelerating_s + accelerating_s if step_um else 0.0
    assert arrival * PERIOD_S <= shortest_s + 0.02


@pytest.mark.parametrize("offset_mm", [-50, -5, 5, 50])
@pytest.mark.parametrize("jump_at", [500, 2500, 4500, 7500])
def test_a_jump_of_a_moving_reference_is_caught_up_and_then_passes(offset_mm, jump_at):
    counts = references.setpoint_counts(references.sine(np.arange(10_000) * PERIOD_S))
    counts[jump_at:] += offset_mm * 10_000
    setpoints = to_kernel(counts)
    limited = limit(setpoints)
    assert np.array_equal(limited[:jump_at], setpoints[:jump_at])
    overshoot_um = ((limited - setpoints)[jump_at:] * np.sign(offset_mm)).max() * LSB_UM
    assert overshoot_um <= 1.0
    # closing 50 mm at the difference of 0.14 m/s and the sine's 0.094 m/s takes longest
    arrival = jump_at + int(np.argmax((limited == setpoints)[jump_at:]))
    assert arrival - jump_at <= 1500
    assert np.array_equal(limited[arrival:], setpoints[arrival:])


def test_a_single_wild_setpoint_moves_the_output_by_micrometres():
    setpoints = np.zeros(200, np.int32)
    setpoints[50] = 2**30
    assert np.abs(limit(setpoints)).max() * LSB_UM <= 3.0
