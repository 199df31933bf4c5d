"""Machine words: the only names whose meaning depends on what runs restricted Python.

Plain Python leaves widths unchecked; `firmware_py.checked` and `dbc.restricted` replace them with
their own. Annotations give the C types.
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


def low32(value: int64) -> int32:
    """Return the low 32 bits, in two's complement."""
    return (value + 2**31) % 2**32 - 2**31


def clz(value: int64) -> int32:
    """Leading zeros of the 64-bit `value` > 0: CLZ where there is one."""
    return 64 - value.bit_length()


def div32(dividend: int32, divisor: int32) -> int32:
    """Quotient of `dividend` >= 0 and `divisor` > 0: one UDIV where there is one."""
    return dividend // divisor
