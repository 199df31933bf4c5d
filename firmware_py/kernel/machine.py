"""Machine words: the only names whose meaning depends on what runs the kernel.

Plain Python leaves widths unchecked; `firmware_py.checked` and `firmware_py.compiled` replace `i32` and
`i64` with their own. Annotations give the C types.
"""

int32 = int
int64 = int
Array32 = memoryview


def i32(value: int64) -> int32:
    """Narrow to 32 bits; the value must fit."""
    return value


def i64(value: int32) -> int64:
    """Widen to 64 bits."""
    return value


def div(dividend: int64, divisor: int64) -> int64:
    """Quotient truncated towards zero, as in C; `divisor` must be positive where it is called."""
    quotient = abs(dividend) // abs(divisor)
    if (dividend < 0) != (divisor < 0):
        quotient = -quotient
    return quotient
