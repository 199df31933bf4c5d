"""Tracking differentiator (eq. 18) on fhan (eq. 19)."""

from dbc.machine import Array32, i32, i64, int32, int64
from firmware_py.kernel.fixedpoint import absolute, clamp, gain, isqrt, round_shift, store
from firmware_py.kernel.layout import CAL_TD_D, CAL_TD_H, CAL_TD_K, ST_V1, ST_V2, ST_V3

WORK_LIMIT = 17179869184  # 1 m in 2^-34 m


def td_reset(state: Array32, position: int32) -> None:
    """Start at rest at `position` (2^-31 m)."""
    state[ST_V1] = position
    state[ST_V2] = 0
    state[ST_V3] = 0


def switching_error(x1: int64, a0: int64, d: int64) -> int64:
    """a of eq. 19, kept within +-`d`: by how much the motion misses the switching curve.

    Parameters
    ----------
    x1, a0, d : int64
        Position error, h0 x2 and r0 h0^2, 2^-34 m; 0 < d <= 2^25.
    """
    y = clamp(x1 + a0, i64(WORK_LIMIT))
    a = a0 + y
    distance = absolute(y)
    if distance > d:
        half = (isqrt(d * (d + (distance << 3))) - d) >> 1
        if y < 0:
            half = -half
        a = a0 + half
    return clamp(a, d)


def td_step(calibration: Array32, state: Array32, setpoint: int32) -> None:
    """Advance v1, v2, v3 by one period towards `setpoint` (2^-31 m).

    fhan is -r0 a / d: the quotient r0 / d is 1 / h0^2.
    """
    v1 = i64(state[ST_V1])
    v2 = state[ST_V2]
    error = (v1 - i64(setpoint)) << 3
    a = switching_error(error, gain(calibration, CAL_TD_H, v2), i64(calibration[CAL_TD_D]))
    acceleration = -gain(calibration, CAL_TD_K, i32(a))
    store(state, ST_V1, v1 + round_shift(i64(v2), 7))
    store(state, ST_V2, i64(v2) + round_shift(acceleration, 2))
    store(state, ST_V3, acceleration)
