"""P and PI position control, PI also with velocity feed-forward.

The integral part stops growing while the drive's speed limits the command.
"""

from dbc.machine import Array32, i64, int32
from firmware_py.kernel.fixedpoint import gain, sat32, store
from firmware_py.kernel.front_end import feed_forward, front_end_step
from firmware_py.kernel.layout import CAL_P_KP, CAL_PI_KI, CAL_PI_KP, CAL_U_LIMIT, ST_INTEGRAL


def pi_reset(state: Array32) -> None:
    """Empty the integral part."""
    state[ST_INTEGRAL] = 0


def p_step(calibration: Array32, setpoint: int32, position: int32) -> int32:
    """Wanted speed (2^-20 rad/s) from `setpoint` and `position` (2^-31 m)."""
    return sat32(gain(calibration, CAL_P_KP, sat32(i64(setpoint) - i64(position))))


def pi_step(
    calibration: Array32, state: Array32, setpoint: int32, position: int32, feedforward: int32
) -> int32:
    """Wanted speed (2^-20 rad/s) from `setpoint` and `position` (2^-31 m) and a known part of it."""
    e = sat32(i64(setpoint) - i64(position))
    u_limit = calibration[CAL_U_LIMIT]
    direct = gain(calibration, CAL_PI_KP, e) + i64(feedforward)
    u = direct + i64(state[ST_INTEGRAL])
    if (u < u_limit or e < 0) and (u > -u_limit or e > 0):
        store(state, ST_INTEGRAL, i64(state[ST_INTEGRAL]) + gain(calibration, CAL_PI_KI, e))
    return sat32(direct + i64(state[ST_INTEGRAL]))


def pi_ff_step(calibration: Array32, state: Array32, limited: int32, position: int32) -> int32:
    """Wanted speed (2^-20 rad/s) from the `limited` setpoint and `position` (2^-31 m)."""
    front_end_step(calibration, state, limited)
    return pi_step(calibration, state, limited, position, feed_forward(calibration, state))
