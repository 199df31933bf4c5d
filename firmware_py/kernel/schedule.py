"""Stiffness of the two oil columns over the stroke, which b0 and a1n of the nominal model are scheduled on.

By eqs 20 to 22 both are proportional to A_A / V1(x) and A_B / V2(x), summed with the areas (a1n) or the
displacements (b0) as weights, 0.75 and 0.72: one ratio serves both.
"""

from dbc.machine import Array32, i64, int32, int64
from firmware_py.kernel.fixedpoint import clamp, mul_q, quotient, sat32
from firmware_py.kernel.layout import (
    CAL_STIFFNESS_A,
    CAL_STIFFNESS_B,
    CAL_STIFFNESS_END_A,
    CAL_STIFFNESS_END_B,
    CAL_STROKE,
)

ONE = 281474976710656  # 1 of the ratios, squared
RATIO_SHIFT = 24  # LSB of the ratios: 2^-24


def column(share: int32, length: int64) -> int64:
    """Stiffness (2^-24) of a column: `share` / `length`, both 2^-31 m, of which at most 1 m counts."""
    return i64(quotient(i64(share) << RATIO_SHIFT, sat32(length)))


def stiffness(calibration: Array32, position: int32) -> int32:
    """Stiffness (2^-24) at `position` (2^-31 m, kept within the stroke) over that at its reference."""
    half = i64(calibration[CAL_STROKE]) >> 1
    x = half + clamp(i64(position) - half, half)
    column_a = column(calibration[CAL_STIFFNESS_A], x + i64(calibration[CAL_STIFFNESS_END_A]))
    length_b = i64(calibration[CAL_STROKE]) - x + i64(calibration[CAL_STIFFNESS_END_B])
    return sat32(column_a + column(calibration[CAL_STIFFNESS_B], length_b))


def softness(ratio: int32) -> int32:
    """Reciprocal of a stiffness >= 0, both 2^-24."""
    return quotient(i64(ONE), ratio)


def scaled(value: int32, ratio: int32) -> int32:
    """`value` times a stiffness or softness (2^-24)."""
    return sat32(mul_q(value, ratio, RATIO_SHIFT))
