"""Front end of the laws with feed-forward: the limited setpoint's speed, and the motor speed it takes.

The setpoint limiter limits speed and slew and leaves a feasible setpoint untouched, so that nothing lags.
"""

from dbc.machine import Array32, i64, int32
from firmware_py.kernel.fixedpoint import gain, round_shift, sat32, store
from firmware_py.kernel.layout import (
    CAL_FRONT_EXTEND,
    CAL_FRONT_LEAD,
    CAL_FRONT_RETRACT,
    CAL_FRONT_SMOOTH,
    ST_LIMITER_RATE,
    ST_V1,
    ST_V2,
    ST_V2_SMOOTH,
    ST_V3,
)


def front_end_reset(state: Array32, position: int32) -> None:
    """Start at rest at `position` (2^-31 m)."""
    state[ST_V1] = position
    state[ST_V2] = 0
    state[ST_V3] = 0
    state[ST_V2_SMOOTH] = 0


def model_speed(calibration: Array32, velocity: int32) -> int32:
    """Motor speed (2^-20 rad/s) that moves the rod steadily at `velocity` (2^-38 m per T).

    A pump loses from the high to the low pressure: the cylinder that carries a load takes more speed to
    extend (eqs 1, 2: A / (eta D)) than to retract.
    """
    if velocity > 0:
        return sat32(gain(calibration, CAL_FRONT_EXTEND, velocity))
    return sat32(gain(calibration, CAL_FRONT_RETRACT, velocity))


def front_end_step(calibration: Array32, state: Array32, limited: int32) -> None:
    """Take v1, v2 from the limiter, and v3 from v2 through a low-pass: `limited` is in 2^-31 m."""
    store(state, ST_V2, i64(state[ST_LIMITER_RATE]) << 7)
    change = sat32(i64(state[ST_V2]) - i64(state[ST_V2_SMOOTH]))
    store(state, ST_V3, gain(calibration, CAL_FRONT_SMOOTH, change))
    store(state, ST_V2_SMOOTH, i64(state[ST_V2_SMOOTH]) + round_shift(i64(state[ST_V3]), 2))
    state[ST_V1] = limited


def feed_forward(calibration: Array32, state: Array32) -> int32:
    """Motor speed (2^-20 rad/s) for v2, led by the time that filter, bus and motor take."""
    led = i64(state[ST_V2]) + gain(calibration, CAL_FRONT_LEAD, state[ST_V3])
    return model_speed(calibration, sat32(led))
