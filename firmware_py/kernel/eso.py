"""Extended state observer (eq. 26 with a linear zone): position, speed, acceleration, total disturbance."""

from dbc.machine import Array32, i64, int32
from firmware_py.kernel.fal import fal, octaves_beyond
from firmware_py.kernel.fixedpoint import gain, round_shift, sat32, store
from firmware_py.kernel.layout import (
    CAL_ESO_A1,
    CAL_ESO_A2,
    CAL_ESO_B0,
    CAL_ESO_BETA1,
    CAL_ESO_BETA2,
    CAL_ESO_BETA3,
    CAL_ESO_BETA4,
    CAL_ESO_DELTA,
    ST_U,
    ST_Z1,
    ST_Z2,
    ST_Z3,
    ST_Z4,
)


def eso_reset(state: Array32, position: int32) -> None:
    """Start at rest at `position` (2^-31 m), undisturbed."""
    state[ST_Z1] = position
    state[ST_Z2] = 0
    state[ST_Z3] = 0
    state[ST_Z4] = 0


def eso_step(calibration: Array32, state: Array32, position: int32) -> None:
    """Advance z1..z4 by one period, from `position` (2^-31 m) and the command sent last."""
    z1 = i64(state[ST_Z1])
    z2 = state[ST_Z2]
    z3 = state[ST_Z3]
    z4 = i64(state[ST_Z4])
    delta = calibration[CAL_ESO_DELTA]
    e = sat32(z1 - i64(position))
    octaves = octaves_beyond(calibration, CAL_ESO_DELTA, e)
    fal_1_4 = fal(e, delta, octaves >> 2)
    fal_1_8 = fal(e, delta, octaves >> 3)
    store(state, ST_Z1, z1 + round_shift(i64(z2), 7) - gain(calibration, CAL_ESO_BETA1, e))
    store(state, ST_Z2, i64(z2) + round_shift(i64(z3), 2) - gain(calibration, CAL_ESO_BETA2, e))
    model = gain(calibration, CAL_ESO_A1, z2) + gain(calibration, CAL_ESO_A2, z3)
    drive = gain(calibration, CAL_ESO_B0, state[ST_U])
    correction = gain(calibration, CAL_ESO_BETA3, fal_1_4)
    store(state, ST_Z3, i64(z3) + model + round_shift(z4, 2) + drive - correction)
    store(state, ST_Z4, z4 - gain(calibration, CAL_ESO_BETA4, fal_1_8))
