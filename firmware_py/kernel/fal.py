"""Normalised fal: e within +-delta, else sign(e) delta (\\|e\\| / delta)^alpha.

The normalised form is continuous with slope 1 in its linear zone and composes: fal of alpha after fal of
beta is fal of alpha beta. `e` and `delta` share one LSB, which is the result's.
"""

from dbc.machine import i32, i64, int32
from firmware_py.kernel.fixedpoint import absolute, isqrt


def fal_1_2(e: int32, delta: int32) -> int32:
    """Normalised fal with alpha = 1/2."""
    magnitude = absolute(i64(e))
    if magnitude <= delta:
        return e
    root = isqrt(i64(delta) * magnitude)
    if e < 0:
        return i32(-root)
    return i32(root)


def fal_3_4(e: int32, delta: int32) -> int32:
    """Normalised fal with alpha = 3/4: sqrt(\\|e\\| sqrt(\\|e\\| delta))."""
    magnitude = absolute(i64(e))
    if magnitude <= delta:
        return e
    root = isqrt(magnitude * isqrt(magnitude * i64(delta)))
    if e < 0:
        return i32(-root)
    return i32(root)
