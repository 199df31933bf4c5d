"""The interpreted kernel notices every overflow, and names it."""

import pytest

from firmware_py import checked
from firmware_py.checked import CheckedArray, Int32, Int64, i32, i64


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (lambda: i32(2**31 - 1) + 1, r"int32 \+: 2147483647 \+ 1"),
        (lambda: i32(-(2**31)) - i32(1), r"int32 -: -2147483648 - 1"),
        (lambda: 1 - i32(-(2**31)), r"int32 -"),
        (lambda: i32(65536) * i32(32768), r"int32 \*: 65536 \* 32768"),
        (lambda: i32(1) << 31, r"int32 <<: 1 << 31"),
        (lambda: i32(1) << 32, r"int32 <<"),
        (lambda: i32(1) >> 32, r"int32 >>"),
        (lambda: i64(1) << -1, r"int64 <<"),
        (lambda: -i32(-(2**31)), r"int32 -: - -2147483648"),
        (lambda: i64(2**63 - 1) + i32(1), r"int64 \+"),
        (lambda: i64(2**32) * i64(2**31), r"int64 \*"),
        (lambda: i64(1) << 63, r"int64 <<"),
        (lambda: -i64(-(2**63)), r"int64 -"),
        (lambda: i32(i64(2**31)), r"i32: 2147483648"),
        (lambda: i64(2**63), r"i64: "),
    ],
)
def test_an_overflow_raises_where_it_happens(expression, message):
    with pytest.raises(OverflowError, match=message):
        expression()


def test_widths_follow_c():
    assert type(i32(1) + i32(1)) is Int32
    assert type(i32(1) + 1) is Int32
    assert type(i32(1) + i64(1)) is Int64
    assert type(i64(1) - i32(1)) is Int64
    assert type(1 - i64(1)) is Int64
    assert type(i32(1) << 3) is Int32
    assert type(-i64(1)) is Int64
    assert i64(2**31) * i64(2**31) == 2**62
    assert i32(-3) >> 1 == -2


def test_division_by_operator_does_not_exist():
    for operation in (lambda: i32(4) // 2, lambda: i64(4) / 2, lambda: i32(4) % 2, lambda: i32(4) ** 2):
        with pytest.raises(TypeError):
            operation()


def test_division_by_zero_raises():
    with pytest.raises(ZeroDivisionError):
        checked.div32(i32(1), i32(0))


def test_arrays_load_32_bits_and_refuse_unnarrowed_stores():
    array = CheckedArray([1, 2])
    assert type(array[1]) is Int32
    array[0] = i32(5)
    array[1] = 7
    assert array == [5, 7]
    with pytest.raises(TypeError, match="unnarrowed Int64"):
        array[0] = i64(5)
    with pytest.raises(OverflowError):
        array[0] = 2**31


def test_the_kernel_runs_without_builtins_and_without_the_outside(kernel_modules):
    assert {"control", "fixedpoint", "layout"} <= kernel_modules.keys()
    builtins = kernel_modules["control"].__dict__["__builtins__"]
    assert set(builtins) == {"__import__", "range", "len"}
    with pytest.raises(ImportError, match="imports only itself, not math"):
        builtins["__import__"]("math")
