"""Each fixed-point helper against Python's big integers, on checked integers and compiled."""

import functools
import math
from fractions import Fraction

import numba
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import firmware_py.compiled  # noqa: F401  (makes the kernel callable from jitted code)
from dbc import machine
from firmware_py import checked
from firmware_py.kernel import fal, fixedpoint, td, units

INT32 = st.integers(-(2**31), 2**31 - 1)
INT64 = st.integers(-(2**63), 2**63 - 1)
POSITIVE32 = st.integers(1, 2**31 - 1)
SHIFT = st.integers(1, 62)


@numba.njit
def compiled_isqrt(value):
    return fixedpoint.isqrt(value)


@numba.njit
def compiled_low32(value):
    return machine.low32(value)


@numba.njit
def compiled_clz(value):
    return machine.clz(value)


@numba.njit
def compiled_div32(dividend, divisor):
    return machine.div32(dividend, divisor)


@numba.njit
def compiled_quotient(dividend, divisor):
    return fixedpoint.quotient(np.int64(dividend), np.int32(divisor))


def checked_quotient(dividend, divisor):
    return int(FIXED.quotient(checked.i64(dividend), checked.i32(divisor)))


@numba.njit
def compiled_mul_q(value, mantissa, shift):
    return fixedpoint.mul_q(value, mantissa, shift)


@numba.njit
def compiled_gain(value, mantissa, shift):
    return fixedpoint.gain(np.array([mantissa, shift], np.int32), 0, value)


def checked_gain(value, mantissa, shift):
    return int(FIXED.gain(checked.CheckedArray([mantissa, shift]), 0, checked.i32(value)))


@numba.njit
def compiled_sat32(value):
    return fixedpoint.sat32(value)


@numba.njit
def compiled_fal(eighths, e, delta):
    zone = np.array([delta, fal.log2_q22(delta)], np.int32)
    if eighths == 6:
        return fal.fal_3_4(zone, 0, e)
    return fal.fal(e, delta, fal.octaves_beyond(zone, 0, e) >> (3 if eighths == 1 else 2))


def checked_fal(eighths, e, delta):
    module, e, delta = MODULES["fal"], checked.i32(e), checked.i32(delta)
    zone = checked.CheckedArray([int(delta), int(module.log2_q22(delta))])
    if eighths == 6:
        return int(module.fal_3_4(zone, 0, e))
    return int(module.fal(e, delta, module.octaves_beyond(zone, 0, e) >> (3 if eighths == 1 else 2)))


@numba.njit
def compiled_switching_error(x1, a0, d):
    return td.switching_error(x1, a0, d)


MODULES = checked.load()


def wide(function):
    """Call a checked kernel function with 64-bit arguments."""
    return lambda *arguments: int(function(*map(checked.i64, arguments)))


def narrow(function):
    """Call a checked kernel function with 32-bit arguments."""
    return lambda *arguments: int(function(*map(checked.i32, arguments)))


FIXED = MODULES["fixedpoint"]
ISQRT = pytest.mark.parametrize("isqrt", [wide(FIXED.isqrt), compiled_isqrt], ids=["checked", "compiled"])
QUOTIENT = pytest.mark.parametrize(
    "quotient", [checked_quotient, compiled_quotient], ids=["checked", "compiled"]
)
LOW32 = pytest.mark.parametrize(
    "low32",
    [machine.low32, wide(MODULES["machine"].low32), compiled_low32],
    ids=["plain", "checked", "compiled"],
)
CLZ = pytest.mark.parametrize(
    "clz", [machine.clz, wide(MODULES["machine"].clz), compiled_clz], ids=["plain", "checked", "compiled"]
)
DIV32 = pytest.mark.parametrize(
    "div32",
    [machine.div32, narrow(MODULES["machine"].div32), compiled_div32],
    ids=["plain", "checked", "compiled"],
)
MUL_Q = pytest.mark.parametrize("mul_q", [narrow(FIXED.mul_q), compiled_mul_q], ids=["checked", "compiled"])
GAIN = pytest.mark.parametrize("gain", [checked_gain, compiled_gain], ids=["checked", "compiled"])
SAT32 = pytest.mark.parametrize("sat32", [wide(FIXED.sat32), compiled_sat32], ids=["checked", "compiled"])
FAL = pytest.mark.parametrize(
    ("alpha", "power"),
    [
        (eighths / 8, functools.partial(how, eighths))
        for how in (checked_fal, compiled_fal)
        for eighths in (1, 2, 6)
    ],
    ids=[f"{how}-{alpha}" for how in ("checked", "compiled") for alpha in ("1/8", "1/4", "3/4")],
)
SWITCHING_ERROR = pytest.mark.parametrize(
    "switching_error",
    [wide(MODULES["td"].switching_error), compiled_switching_error],
    ids=["checked", "compiled"],
)


@ISQRT
@given(value=st.integers(0, 2**63 - 1))
def test_isqrt_is_the_floor_of_the_square_root(isqrt, value):
    assert isqrt(value) == math.isqrt(value)


@ISQRT
def test_isqrt_around_squares_and_powers_of_four(isqrt):
    roots = [1, 2, 3, 46340, 46341, 2**31 - 1, 2**31, 3037000499]
    values = [4**n for n in range(31)] + [root**2 for root in roots]
    for value in values:
        for neighbour in (value - 1, value, value + 1):
            assert isqrt(neighbour) == math.isqrt(neighbour), neighbour


@numba.njit
def first_wrong_root(values):
    """The first of `values` whose root is not its floor, or -1."""
    for value in values:
        root = fixedpoint.isqrt(value)
        if not (root * root <= value and value - root * root <= 2 * root):
            return value
    return -1


def test_isqrt_of_a_million_random_numbers_of_every_size():
    rng = np.random.default_rng(4)
    values = rng.integers(0, 2**63 - 1, 1_000_000) >> rng.integers(0, 63, 1_000_000)
    assert first_wrong_root(values) == -1


def test_isqrt_wherever_its_first_half_can_change():
    """The polynomial changes with the head's upper bits, the root with squares; between, all is monotonic."""
    squares = np.arange(23170, 46342) ** 2
    heads = np.unique(np.concatenate([squares, np.arange(2**14, 2**16 + 1) << 15]))
    heads = np.concatenate([heads - 1, heads])
    heads = heads[(heads >= 2**29) & (heads < 2**31)]
    assert len(heads) > 140_000
    for low in (0, 1, 2**29, 2**30 - 2, 2**30 - 1):
        assert first_wrong_root((heads << 30) + low) == -1


@numba.njit
def first_wrong_head(low):
    """The first head of all, with the 30 bits `low` below it, whose root is not its floor, or -1."""
    for head in range(2**29, 2**31):
        value = (head << 30) + low
        root = fixedpoint.isqrt(value)
        if not (root * root <= value and value - root * root <= 2 * root):
            return value
    return -1


@pytest.mark.long
@pytest.mark.parametrize("low", [0, 2**30 - 1])
def test_isqrt_of_every_head(low):
    assert first_wrong_head(low) == -1


@QUOTIENT
@given(dividend=st.integers(0, 2**63 - 1), divisor=st.integers(0, 2**31 - 1))
@example(dividend=2**62 - 1, divisor=2**31 - 1)
@example(dividend=0, divisor=0)
def test_quotient_is_the_floor_or_the_largest_number(quotient, dividend, divisor):
    floor = dividend // divisor if divisor else 2**31 - 1
    assert quotient(dividend, divisor) == min(floor, 2**31 - 1)


@QUOTIENT
@given(floor=st.integers(0, 2**31 - 1), divisor=POSITIVE32)
@example(floor=2**31 - 1, divisor=2**31 - 1)
@example(floor=2**31 - 1, divisor=2**30)
def test_quotient_around_whole_ones(quotient, floor, divisor):
    assert quotient(floor * divisor, divisor) == floor
    assert quotient(floor * divisor + divisor - 1, divisor) == floor


@LOW32
@given(value=INT64)
@example(value=2**31)
@example(value=-(2**31) - 1)
@example(value=2**32 - 1)
def test_low32_keeps_the_low_bits(low32, value):
    assert low32(value) == int.from_bytes((value % 2**32).to_bytes(4, "little"), "little", signed=True)


@CLZ
@given(value=st.integers(1, 2**63 - 1))
@example(value=1)
@example(value=2**32)
def test_clz_counts_the_zeros_before_the_leading_one(clz, value):
    assert clz(value) == len(f"{value:064b}".split("1")[0])


@DIV32
@given(dividend=st.integers(0, 2**31 - 1), divisor=POSITIVE32)
@example(dividend=2**31 - 1, divisor=1)
def test_div32_is_the_quotient(div32, dividend, divisor):
    assert div32(dividend, divisor) == math.trunc(Fraction(dividend, divisor))


@pytest.mark.parametrize(
    ("word", "arguments"), [("clz", [0]), ("clz", [-1]), ("div32", [-1, 2]), ("div32", [1, -2])]
)
def test_machine_words_refuse_what_c_leaves_undefined(word, arguments):
    with pytest.raises(OverflowError, match=word):
        getattr(checked, word)(*arguments)


def test_div32_refuses_a_zero_divisor():
    with pytest.raises(ZeroDivisionError):
        checked.div32(1, 0)


@MUL_Q
@given(value=INT32, mantissa=INT32, shift=SHIFT)
@example(value=-1, mantissa=1, shift=1)
@example(value=-(2**31), mantissa=-(2**31), shift=62)
def test_mul_q_rounds_half_up(mul_q, value, mantissa, shift):
    assert mul_q(value, mantissa, shift) == math.floor(Fraction(value * mantissa, 2**shift) + Fraction(1, 2))


@GAIN
@given(value=INT32, mantissa=INT32, shift=st.integers(8, 62))
@example(value=-1, mantissa=1, shift=8)
@example(value=-(2**31), mantissa=-(2**31), shift=62)
def test_gain_rounds_half_up(gain, value, mantissa, shift):
    assert gain(value, mantissa, shift) == math.floor(Fraction(value * mantissa, 2**shift) + Fraction(1, 2))


@SAT32
@given(value=INT64)
@example(value=2**31 - 1)
@example(value=2**31)
@example(value=-(2**31))
@example(value=-(2**31) - 1)
def test_sat32_keeps_what_fits_and_clips_the_rest(sat32, value):
    assert sat32(value) == min(max(value, -(2**31)), 2**31 - 1)


@FAL
@given(e=INT32, delta=POSITIVE32)
@example(e=-(2**31), delta=1)
@example(e=-(2**31), delta=2**31 - 1)
@example(e=2**31 - 1, delta=2**31 - 2)
def test_fal_is_linear_up_to_delta_and_the_real_power_to_3e_6_beyond(alpha, power, e, delta):
    result = power(e, delta)
    if abs(e) <= delta:
        assert result == e
        return
    exact = delta * (abs(e) / delta) ** alpha
    assert exact * (1 - 3e-6) - 1 <= abs(result) <= exact * (1 + 3e-6)
    assert delta <= abs(result) <= abs(e)
    assert result * e > 0


@FAL
@given(e=INT32, step=st.integers(0, 2**12), delta=POSITIVE32)
def test_fal_is_monotonic(alpha, power, e, step, delta):
    assert power(e, delta) <= power(min(e + step, 2**31 - 1), delta)


@pytest.mark.parametrize("delta", [1, 7, 214748, 2**31 - 2])
@pytest.mark.parametrize("sign", [1, -1])
@FAL
def test_fal_is_continuous_at_delta(alpha, power, delta, sign):
    assert power(sign * delta, delta) == sign * delta
    assert 0 <= sign * power(sign * (delta + 1), delta) - delta <= 1


def test_the_tables_are_the_functions_rounded():
    assert tuple(round(2**22 * math.log2(1 + n / 256)) for n in range(257)) == fal.LOG2
    assert tuple(round(2**22 * 2 ** (n / 256)) for n in range(257)) == fal.EXP2


@numba.njit
def furthest_from_the_power(delta, octave, eighths):
    """Relative errors, least and most, at each mantissa of 23 bits of an octave; 1 where fal falls."""
    least, most, last = 0.0, 0.0, 0
    for mantissa in range(2**22, 2**23):
        e = (mantissa << octave) >> 22
        if e > delta:
            result = compiled_fal(eighths, e, delta)
            exact = delta * (e / delta) ** (eighths / 8)
            least, most = min(least, (result + 1 - exact) / exact), max(most, (result - exact) / exact)
            if result < last:
                return -1.0, 1.0
            last = result
    return least, most


@pytest.mark.parametrize("eighths", [1, 2, 6])
@pytest.mark.parametrize("delta", [1000, 214_748, 10_995_116])
def test_every_mantissa_is_within_3e_6_of_the_power_and_not_below_the_last(delta, eighths):
    for octave in (23, 24, 27, 30):
        least, most = furthest_from_the_power(delta, octave, eighths)
        assert -3e-6 < least <= most < 3e-6


def fhan_in_floats(x1, x2, r, h):
    """Eq. 19."""
    d = r * h * h
    a0 = h * x2
    y = x1 + a0
    a = a0 + y if abs(y) <= d else a0 + math.copysign((math.sqrt(d * (d + 8 * abs(y))) - d) / 2, y)
    return -r * a / d if abs(a) <= d else -math.copysign(r, a)


@SWITCHING_ERROR
@given(x1_m=st.floats(-0.9, 0.9), x2_m_s=st.floats(-0.5, 0.5))
@example(x1_m=1e-7, x2_m_s=0.0)
@example(x1_m=25 * 0.005**2, x2_m_s=0.0)
def test_the_switching_error_over_h0_squared_is_fhan_of_eq_19(switching_error, x1_m, x2_m_s):
    r, h = 25.0, 5e-3
    x1, a0 = round(x1_m * 2**34), round(h * x2_m_s * 2**34)
    acceleration = -switching_error(x1, a0, round(r * h * h * 2**34)) / 2**34 / h**2
    # one LSB of a is r / d = 2.3e-6 m/s^2
    assert acceleration == pytest.approx(fhan_in_floats(x1_m, x2_m_s, r, h), abs=2e-5)


@pytest.mark.parametrize(
    ("convert", "count", "value", "lsb"),
    [
        (units.metres_from_setpoint, 4_000_000, 0.4, 2**-31),
        (units.metres_from_position, 400_000, 0.4, 2**-31),
        (units.speed_from_velocity, 12_000, 100 * math.pi, 2**-20),
        (units.velocity_from_speed, round(100 * math.pi * 2**20), 3000.0, 0.25),
    ],
)
def test_unit_conversions_are_right_to_half_an_lsb(convert, count, value, lsb):
    assert abs(convert(count) * lsb - value) <= 0.5 * lsb
    assert abs(convert(-count) * lsb + value) <= 0.5 * lsb


def test_quantised_velocities_survive_the_round_trip():
    for velocity in range(-12_000, 12_001):
        assert units.velocity_from_speed(units.speed_from_velocity(velocity)) == velocity
