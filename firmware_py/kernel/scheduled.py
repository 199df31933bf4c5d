"""Linear ADRC whose model follows the position: front end, scheduled observer, feedback, in this order.

The observer is eq. 26 with e in place of fal and the disturbance z4 = b0(x) w kept as the speed w, because
what disturbs most, the pumps' leakage, is a speed at any position. With a1n = -b0 kappa (both have the oil's
stiffness as a factor, eqs 20 to 22; 1 / kappa is the rod's speed per motor speed) its third line is

    dz3/dt = b0(x) (u + w - kappa z2) - beta03 e,    dw/dt = -beta04 / b0(x) e

and the feedback, eq. 27 divided by b0: u = K1 e1 + K2 e2 - K3(x) z3 + kappa v2 - w.
"""

from dbc.machine import Array32, i64, int32
from firmware_py.kernel.fixedpoint import gain, round_shift, sat32, store
from firmware_py.kernel.front_end import feed_forward, front_end_step, model_speed
from firmware_py.kernel.layout import (
    CAL_SCHEDULED_B0,
    CAL_SCHEDULED_BETA1,
    CAL_SCHEDULED_BETA2,
    CAL_SCHEDULED_BETA3,
    CAL_SCHEDULED_BETA4,
    CAL_SCHEDULED_BETA4_SOFT,
    CAL_SCHEDULED_K1,
    CAL_SCHEDULED_K2,
    CAL_SCHEDULED_K3,
    CAL_SCHEDULED_K3_SOFT,
    CAL_SCHEDULED_MOTOR,
    ST_DISTURBANCE,
    ST_MOTOR,
    ST_U,
    ST_V1,
    ST_V2,
    ST_Z1,
    ST_Z2,
    ST_Z3,
    ST_Z4,
)
from firmware_py.kernel.schedule import scaled, softness, stiffness


def scheduled_reset(state: Array32) -> None:
    """Start with the motor at rest, undisturbed; `eso_reset` and `front_end_reset` do the rest."""
    state[ST_MOTOR] = 0
    state[ST_DISTURBANCE] = 0


def observe(calibration: Array32, state: Array32, position: int32, stiff: int32, soft: int32) -> None:
    """Advance z1, z2, z3 and w by one period, from `position` (2^-31 m) and the command sent last."""
    z1 = i64(state[ST_Z1])
    z2 = state[ST_Z2]
    z3 = i64(state[ST_Z3])
    w = i64(state[ST_DISTURBANCE])
    e = sat32(z1 - i64(position))
    lag = sat32(i64(state[ST_U]) - i64(state[ST_MOTOR]))
    store(state, ST_MOTOR, i64(state[ST_MOTOR]) + gain(calibration, CAL_SCHEDULED_MOTOR, lag))
    drive = sat32(i64(state[ST_MOTOR]) + w - i64(model_speed(calibration, z2)))
    jerk = gain(calibration, CAL_SCHEDULED_B0, scaled(drive, stiff))
    correction = gain(calibration, CAL_SCHEDULED_BETA4, e)
    correction = correction + gain(calibration, CAL_SCHEDULED_BETA4_SOFT, scaled(e, soft))
    store(state, ST_Z1, z1 + round_shift(i64(z2), 7) - gain(calibration, CAL_SCHEDULED_BETA1, e))
    store(state, ST_Z2, i64(z2) + round_shift(z3, 2) - gain(calibration, CAL_SCHEDULED_BETA2, e))
    store(state, ST_Z3, z3 + jerk - gain(calibration, CAL_SCHEDULED_BETA3, e))
    store(state, ST_DISTURBANCE, w - correction)
    store(state, ST_Z4, gain(calibration, CAL_SCHEDULED_B0, scaled(state[ST_DISTURBANCE], stiff)) << 2)


def feedback(calibration: Array32, state: Array32, soft: int32) -> int32:
    """Wanted speed (2^-20 rad/s); v1 is led by one period to meet the k+1 values of the observer."""
    e1 = sat32(i64(state[ST_V1]) + round_shift(i64(state[ST_V2]), 7) - i64(state[ST_Z1]))
    e2 = sat32(i64(state[ST_V2]) - i64(state[ST_Z2]))
    z3 = state[ST_Z3]
    damping = gain(calibration, CAL_SCHEDULED_K3, z3)
    damping = damping + gain(calibration, CAL_SCHEDULED_K3_SOFT, scaled(z3, soft))
    errors = gain(calibration, CAL_SCHEDULED_K1, e1) + gain(calibration, CAL_SCHEDULED_K2, e2)
    known = i64(feed_forward(calibration, state)) - i64(state[ST_DISTURBANCE])
    return sat32(errors - damping + known)


def scheduled_step(calibration: Array32, state: Array32, limited: int32, position: int32) -> int32:
    """Wanted speed (2^-20 rad/s) from the `limited` setpoint and `position` (2^-31 m)."""
    front_end_step(calibration, state, limited)
    stiff = stiffness(calibration, position)
    soft = softness(stiff)
    observe(calibration, state, position, stiff, soft)
    return feedback(calibration, state, soft)
