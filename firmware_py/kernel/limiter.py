"""Setpoint limiter: velocity and acceleration limits that leave a feasible reference untouched."""

from dbc.machine import Array32, i32, i64, int32, int64
from firmware_py.kernel.fixedpoint import absolute, clamp, isqrt, sat32
from firmware_py.kernel.layout import (
    CAL_LIMITER_BRAKE,
    CAL_LIMITER_RATE,
    CAL_LIMITER_SLEW,
    ST_LIMITER_INPUT,
    ST_LIMITER_POSITION,
    ST_LIMITER_RATE,
)


def limiter_reset(state: Array32, position: int32) -> None:
    """Start at rest at `position` (2^-31 m)."""
    state[ST_LIMITER_INPUT] = position
    state[ST_LIMITER_POSITION] = position
    state[ST_LIMITER_RATE] = 0


def approach(gap: int64, brake: int64) -> int64:
    """Largest increment towards a gap that still stops in it when each next one is `brake` smaller.

    Increments s, s - brake, ... 0 cover s (s + brake) / (2 brake); a gap within `brake` is closed at once.
    """
    distance = absolute(gap)
    if distance <= brake:
        return gap
    increment = (isqrt(brake * (brake + (distance << 3))) - brake) >> 1
    if gap < 0:
        return -increment
    return increment


def limiter_step(calibration: Array32, state: Array32, setpoint: int32) -> int32:
    """Limited setpoint (2^-31 m); equal to `setpoint` while that moves within the limits.

    The gap is closed relative to the moving setpoint: its increment is added, so it is not lagged. An
    increment beyond the rate limit is a jump, not a motion. The approach does not foresee a setpoint that
    brakes at the limit itself meanwhile: such a one is overshot.
    """
    rate_limit = i64(calibration[CAL_LIMITER_RATE])
    position = i64(state[ST_LIMITER_POSITION])
    rate = i64(state[ST_LIMITER_RATE])
    motion = i64(setpoint) - i64(state[ST_LIMITER_INPUT])
    if absolute(motion) > rate_limit:
        motion = i64(0)
    gap = i64(setpoint) - motion - position
    wanted = clamp(motion + approach(gap, i64(calibration[CAL_LIMITER_BRAKE])), rate_limit)
    rate = rate + clamp(wanted - rate, i64(calibration[CAL_LIMITER_SLEW]))
    state[ST_LIMITER_INPUT] = setpoint
    state[ST_LIMITER_POSITION] = sat32(position + rate)
    state[ST_LIMITER_RATE] = i32(rate)
    return state[ST_LIMITER_POSITION]
