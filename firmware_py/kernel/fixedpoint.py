"""Fixed-point arithmetic: one rounding rule (half up), saturation, exact square root and quotient."""

from dbc.machine import Array32, clz, div32, i32, i64, int32, int64, low32
from firmware_py.kernel.layout import ST_SATURATIONS

INT32_MAX = 2147483647
INT32_MIN = -2147483648


def sat32(value: int64) -> int32:
    """Narrow to 32 bits, saturating."""
    low = low32(value)
    if low == value:
        return low
    if value < 0:
        return INT32_MIN
    return INT32_MAX


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
    """`value` times the gain whose mantissa and shift stand at `index` and `index` + 1, rounded half up.

    Half an LSB is added behind the shift: before it, a shift that is no constant would take a second one.
    """
    product = i64(value) * i64(calibration[index])
    return ((product >> (calibration[index + 1] - 1)) + 1) >> 1


def quotient(dividend: int64, divisor: int32) -> int32:
    """Floor of `dividend` / `divisor`, both >= 0, saturating; by zero it saturates.

    `wide` and `rest` are both times 2^n, `wide` within [2^30, 2^31). Two divisions by its upper 16 bits,
    rounded up, each leave less than two of their last places: 2^17 and 8 times `wide`.
    """
    if dividend >> 31 >= i64(divisor):
        return INT32_MAX
    shift = clz(i64(divisor)) - 33
    wide = divisor << shift
    head = (wide >> 15) + 1
    rest = dividend << shift
    result = div32(i32(rest >> 31), head) << 16
    rest = rest - i64(result) * i64(wide)
    digit = div32(i32(rest >> 17), head) << 2
    result = result + digit
    rest = rest - i64(digit) * i64(wide)
    if rest >= i64(wide) << 2:
        result = result + 4
        rest = rest - (i64(wide) << 2)
    if rest >= i64(wide) << 1:
        result = result + 2
        rest = rest - (i64(wide) << 1)
    if rest >= i64(wide):
        result = result + 1
    return i32(result)


def isqrt(value: int64) -> int64:
    """Floor of the square root of `value` >= 0."""
    if value <= 0:
        return i64(0)
    if value >> 61 > 0:
        root = isqrt_61(value >> 2) << 1
        if value - root * root > root << 1:
            root = root + 1
        return root
    return isqrt_61(value)


def isqrt_61(value: int64) -> int64:
    """Floor of the square root of 0 < `value` < 2^61, in two halves (Zimmermann, "Karatsuba Square Root").

    `wide` is `value` times 4^n within [2^59, 2^61). The root of its `head`, in [2^29, 2^31), is a quadratic
    polynomial with a relative error of at most 0.0051 and one step of Newton's, which gives the floor or one
    more. A division by twice that root gives the other 15 bits, or one too many in the last place.
    """
    shift = ((clz(value) - 3) >> 1) << 1
    wide = value << shift
    head = i32(wide >> 30)
    x = i64(head >> 15)
    slope = 24376 - (i32(i64(3665) * x) >> 15)
    root = 12015 + (i32(x * i64(slope)) >> 15)
    root = (root + div32(head, root)) >> 1
    rest = i32(i64(head) - i64(root) * i64(root))
    if rest < 0:
        rest = rest + (root << 1) - 1
        root = root - 1
    below = i32((wide >> 16) - ((wide >> 30) << 14))
    root = (root << 15) + div32((rest << 14) + below, root)
    if i64(root) * i64(root) > wide:
        root = root - 1
    return i64(root >> (shift >> 1))


def store(state: Array32, index: int32, value: int64) -> None:
    """Store a state, saturating; count it when it saturates."""
    low = low32(value)
    if low == value:
        state[index] = low
    else:
        state[index] = sat32(value)
        state[ST_SATURATIONS] = sat32(i64(state[ST_SATURATIONS]) + 1)
