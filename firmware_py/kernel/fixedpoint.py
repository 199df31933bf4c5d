"""Fixed-point arithmetic: one rounding rule (half up), saturation, and an exact integer square root."""

from firmware_py.kernel.layout import ST_SATURATIONS
from firmware_py.kernel.machine import Array32, i32, i64, int32, int64

INT32_MAX = 2147483647
INT32_MIN = -2147483648


def sat32(value: int64) -> int32:
    """Narrow to 32 bits, saturating."""
    if value > INT32_MAX:
        return INT32_MAX
    if value < INT32_MIN:
        return INT32_MIN
    return i32(value)


def absolute(value: int64) -> int64:
    """Magnitude; `value` must not be the most negative 64-bit number."""
    if value < 0:
        return -value
    return value


def clamp(value: int64, limit: int64) -> int64:
    """`value` kept within +-`limit`, `limit` not negative."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


def round_shift(value: int64, shift: int32) -> int64:
    """Compute value / 2**shift, rounded half up; 1 <= shift <= 62, \\|value\\| <= 2**62."""
    return (value + (i64(1) << (shift - 1))) >> shift


def mul_q(value: int32, mantissa: int32, shift: int32) -> int64:
    """Compute value * mantissa / 2**shift, rounded half up; 1 <= shift <= 62."""
    return round_shift(i64(value) * i64(mantissa), shift)


def gain(calibration: Array32, index: int32, value: int32) -> int64:
    """`value` times the gain whose mantissa and shift stand at `index` and `index` + 1."""
    return mul_q(value, calibration[index], calibration[index + 1])


def isqrt(value: int64) -> int64:
    """Floor of the square root of `value` >= 0, digit by digit from its leading one."""
    bit = i64(1)
    head = value
    if head >> 32 > 0:
        head = head >> 32
        bit = bit << 32
    if head >> 16 > 0:
        head = head >> 16
        bit = bit << 16
    if head >> 8 > 0:
        head = head >> 8
        bit = bit << 8
    if head >> 4 > 0:
        head = head >> 4
        bit = bit << 4
    if head >> 2 > 0:
        bit = bit << 2
    rest = value
    root = i64(0)
    while bit > 0:
        trial = root + bit
        root = root >> 1
        if rest >= trial:
            rest = rest - trial
            root = root + bit
        bit = bit >> 2
    return root


def store(state: Array32, index: int32, value: int64) -> None:
    """Store a state, saturating; count it when it saturates."""
    state[index] = sat32(value)
    if state[index] != value:
        state[ST_SATURATIONS] = sat32(i64(state[ST_SATURATIONS]) + 1)
