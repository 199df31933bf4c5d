"""Nonlinear feedback (eq. 27 with consistent units): u = (u0 - z4 - a1n z2 - a2n z3) / b0."""

from dbc.machine import Array32, i64, int32
from firmware_py.kernel.fal import fal_3_4
from firmware_py.kernel.fixedpoint import gain, sat32
from firmware_py.kernel.layout import (
    CAL_FB_A1,
    CAL_FB_A2,
    CAL_FB_DELTA1,
    CAL_FB_DELTA2,
    CAL_FB_DELTA3,
    CAL_FB_K1,
    CAL_FB_K2,
    CAL_FB_K3,
    CAL_FB_Z4,
    CAL_LEAD_V1,
    CAL_LEAD_V2,
    ST_V1,
    ST_V2,
    ST_V3,
    ST_Z1,
    ST_Z2,
    ST_Z3,
    ST_Z4,
)


def nfcl(calibration: Array32, state: Array32) -> int32:
    """Wanted speed (2^-20 rad/s), not yet clipped to the drive's.

    v1 and v2 lead by 2 h0, the tracking differentiator's lag.
    """
    v2 = state[ST_V2]
    v3 = state[ST_V3]
    z2 = state[ST_Z2]
    z3 = state[ST_Z3]
    e1 = sat32(i64(state[ST_V1]) + gain(calibration, CAL_LEAD_V1, v2) - i64(state[ST_Z1]))
    e2 = sat32(i64(v2) + gain(calibration, CAL_LEAD_V2, v3) - i64(z2))
    e3 = sat32(i64(v3) - i64(z3))
    u0 = (
        gain(calibration, CAL_FB_K1, fal_3_4(calibration, CAL_FB_DELTA1, e1))
        + gain(calibration, CAL_FB_K2, fal_3_4(calibration, CAL_FB_DELTA2, e2))
        + gain(calibration, CAL_FB_K3, fal_3_4(calibration, CAL_FB_DELTA3, e3))
    )
    model = gain(calibration, CAL_FB_A1, z2) + gain(calibration, CAL_FB_A2, z3)
    return sat32(u0 - model - gain(calibration, CAL_FB_Z4, state[ST_Z4]))
