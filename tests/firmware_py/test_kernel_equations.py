"""Every line of the kernel against the same equation in exact fractions, rounded where the layout says.

The kernel's source runs on plain integers; the oracle knows the equations, the LSBs of `layout`, and one
rounding rule: half up after each gain and each change of LSB.
"""

import math
import zlib
from fractions import Fraction

import numpy as np
import pytest

from dbc.contract import Contract
from firmware_py.calibration_block import GAINS, ZONES
from firmware_py.kernel import (
    adrc,
    command_filter,
    control,
    eso,
    fixedpoint,
    front_end,
    limiter,
    nfcl,
    pi,
    schedule,
    scheduled,
    td,
    units,
)
from firmware_py.kernel import fal as powers
from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS

LOW, HIGH = -(2**31), 2**31 - 1
LSB = {"x": -31, "v": -38, "a": -40, "j": -42, "u": -20}
"""Binary exponents of position, velocity T, acceleration T², jerk T³ (m) and speed (rad/s)."""
CASES = pytest.mark.parametrize("seed", range(12))


def half_up(value):
    return math.floor(value + Fraction(1, 2))


def clip(value, low=LOW, high=HIGH):
    return min(max(value, low), high)


def to(value, lsb, new):
    """The same quantity in another LSB."""
    return half_up(Fraction(value) * Fraction(2) ** (LSB[lsb] - LSB[new]))


class Case:
    """A random legal calibration and state, moderate enough that nothing need saturate."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.words = list(TUNINGS["robust"].calibration().words)
        for index in GAINS:
            self.words[index] = int(rng.integers(2**29, 2**31)) * int(rng.choice([-1, 1]))
            self.words[index + 1] = int(rng.integers(29, 33))
        for index in ZONES:
            self.words[index] = int(rng.integers(1000, 200_000))
            self.words[index + 1] = log2(self.words[index])
        self.state = rng.integers(-(10**6), 10**6, k.ST_SIZE).tolist()
        self.state[k.ST_SATURATIONS] = 0
        self.position, self.setpoint = rng.integers(10**5, 10**6, 2).tolist()
        self.before = list(self.state)

    def gain(self, index, value):
        return half_up(Fraction(value * self.words[index], 2 ** self.words[index + 1]))

    def changed(self):
        """Indices and new values of the states that are not as before."""
        return {
            index: new
            for index, (old, new) in enumerate(zip(self.before, self.state, strict=True))
            if old != new
        }

    def assert_became(self, **expected):
        """The states named are as said, all others as before."""
        wanted = list(self.before)
        for name, value in expected.items():
            wanted[getattr(k, "ST_" + name)] = value
        assert self.state == wanted


def straight(function, x):
    """The function in 2^-22, rounded at each 256th of its unit, straight between, rounded down."""
    place, rest = divmod(x * 256, 1)
    left, right = (round(2**22 * function((int(place) + n) / 256)) for n in (0, 1))
    return left + math.floor((right - left) * rest)


def log2(value):
    """Of the leading 23 bits, in 2^-22."""
    octave = value.bit_length() - 1
    leading = Fraction(math.floor(Fraction(value, 2**octave) * 2**22), 2**22)
    return octave * 2**22 + straight(lambda x: math.log2(1 + x), leading - 1)


def fal(e, delta, alpha):
    magnitude = min(abs(e), HIGH)
    if magnitude <= delta:
        return e
    beyond = log2(magnitude) - log2(delta)
    exponent = beyond - math.floor(beyond * Fraction(1, 4)) if alpha == 0.75 else math.floor(beyond * alpha)
    octaves, rest = divmod(exponent, 2**22)
    power = math.floor(delta * 2**octaves * Fraction(straight(lambda x: 2**x, Fraction(rest, 2**22)), 2**22))
    return int(math.copysign(min(power, magnitude), e))


def fal_3_4(e, delta):
    return fal(e, delta, 0.75)


# the layout is the calibration block's format and the trace's


def names(prefix):
    return {name: value for name, value in vars(k).items() if name.startswith(prefix)}


def test_the_calibrations_words_follow_each_other_two_to_a_gain():
    place = 0
    for name, index in names("CAL_").items():
        assert index == place, name
        place += 2 if index in GAINS + ZONES else 1
    assert place - 1 == k.CAL_SIZE


@pytest.mark.parametrize("prefix", ["IO_", "ST_"])
def test_states_and_io_follow_each_other(prefix):
    assert list(names(prefix).values()) == list(range(len(names(prefix))))


def test_flags_are_bits():
    assert list(names("FLAG_").values()) == [1, 2, 4]


def test_laws_have_the_numbers_of_the_bus():
    choices = Contract.load().controller_status.signals["ControlLaw"].choices
    on_bus = {f"LAW_{name.upper()}": number for number, name in choices.items()}
    assert names("LAW_") == on_bus


def test_another_layout_is_another_version():
    words = ",".join(f"{name}={index}" for name, index in names("CAL_").items())
    assert (k.LAYOUT_VERSION, zlib.crc32(words.encode())) == (3, 1544597118)


# arithmetic at its boundaries


@pytest.mark.parametrize("value", [LOW - 1, LOW, LOW + 1, -1, 0, 1, HIGH - 1, HIGH, HIGH + 1])
def test_sat32(value):
    assert fixedpoint.sat32(value) == clip(value)


@pytest.mark.parametrize("value", [-5, -2, -1, 0, 1, 2, 5])
def test_absolute_and_clamp(value):
    assert fixedpoint.absolute(value) == abs(value)
    for limit in (0, 1, 2, 5, 6):
        assert fixedpoint.clamp(value, limit) == clip(value, -limit, limit)


@pytest.mark.parametrize("value", [-9, -8, -7, -4, -1, 0, 1, 3, 4, 7, 8, 9])
@pytest.mark.parametrize("shift", [1, 2, 3])
def test_round_shift_rounds_half_up(value, shift):
    assert fixedpoint.round_shift(value, shift) == half_up(Fraction(value, 2**shift))


def test_gain_takes_mantissa_and_the_shift_behind_it():
    assert fixedpoint.gain([9, 9, 3, 1, 9], 2, 5) == 8


def test_quotient_is_the_floor_and_saturates():
    rng = np.random.default_rng(0)
    divisors = [0, 1, 2, 3, 2**15, 2**16 - 1, 2**30 - 1, 2**30, 2**30 + 2**15 - 1, HIGH]
    divisors += [int(rng.integers(2 ** (bits - 1), 2**bits)) for bits in range(1, 32) for _ in range(20)]
    for divisor in divisors:
        floors = [0, 1, 2, 3, 4, 5, 6, 7, 8, 2**16 - 1, 2**16, HIGH - 1, HIGH, HIGH + 1]
        floors += [int(rng.integers(0, 2**bits)) for bits in range(1, 32)]
        dividends = {floor * divisor + rest for floor in floors for rest in (-1, 0, 1, divisor - 1)}
        for dividend in dividends | {2**63 - 1}:
            if dividend >= 0:
                expected = clip(dividend // divisor) if divisor else HIGH
                assert fixedpoint.quotient(dividend, divisor) == expected, (dividend, divisor)


def test_isqrt_is_the_floor_of_the_root():
    roots = [*range(70), *(2**n for n in range(7, 32)), 46340, 46341, 3037000499]
    for value in {clip(root**2 + off, 0, 2**63 - 1) for root in roots for off in (-1, 0, 1)}:
        assert fixedpoint.isqrt(value) == math.isqrt(value), value
    rng = np.random.default_rng(0)
    for bits in range(1, 64):  # every size, and squares where the two halves of the root meet
        for value in rng.integers(2 ** (bits - 1), 2**bits, 20, dtype=np.uint64).tolist():
            square = math.isqrt(value) ** 2
            for near in {value, square, square - 1 if square else 0}:
                assert fixedpoint.isqrt(near) == math.isqrt(near), near
    assert fixedpoint.isqrt(2**63 - 1) == math.isqrt(2**63 - 1)


@pytest.mark.parametrize(
    ("value", "stored", "counted"),
    [(HIGH, HIGH, 0), (HIGH + 1, HIGH, 1), (LOW, LOW, 0), (LOW - 1, LOW, 1), (3, 3, 0)],
)
def test_store_saturates_and_counts(value, stored, counted):
    state = [0] * k.ST_SIZE
    state[k.ST_SATURATIONS] = 5
    fixedpoint.store(state, k.ST_V1, value)
    assert (state[k.ST_V1], state[k.ST_SATURATIONS]) == (stored, 5 + counted)
    assert sum(map(bool, state)) == 2


def test_the_count_of_saturations_itself_saturates():
    state = [0] * k.ST_SIZE
    state[k.ST_SATURATIONS] = HIGH
    fixedpoint.store(state, k.ST_V1, HIGH + 1)
    assert state[k.ST_SATURATIONS] == HIGH


def test_log2_at_each_256th_of_each_octave_and_beside_it():
    knots = {mantissa << octave >> 8 for mantissa in range(256, 512) for octave in range(31)}
    for value in {near for knot in knots for near in (knot - 1, knot, knot + 1)} - {0}:
        assert powers.log2_q22(value) == log2(value), value


def test_magnitude_saturates():
    assert [powers.magnitude_of(e) for e in (LOW, LOW + 1, -1, 0, 1, HIGH)] == [HIGH, HIGH, 1, 0, 1, HIGH]


@pytest.mark.parametrize("delta", [1, 2, 3, 100, 214_748, 2**30 - 1, HIGH - 1, HIGH])
def test_fal_is_the_identity_up_to_delta_and_a_power_beyond(delta):
    zone = [delta, log2(delta)]
    rng = np.random.default_rng(delta)
    near = [*range(min(delta, HIGH - 200), min(delta + 200, HIGH)), *range(100), HIGH]
    for e in {*near, *rng.integers(0, HIGH, 200).tolist()}:
        for signed in (e, -e):
            octaves = powers.octaves_beyond(zone, 0, signed)
            assert octaves == (log2(e) - log2(delta) if e > delta else 0)
            assert powers.fal(signed, delta, octaves >> 2) == fal(signed, delta, 0.25)
            assert powers.fal(signed, delta, octaves >> 3) == fal(signed, delta, 0.125)
            assert powers.fal_3_4(zone, 0, signed) == fal_3_4(signed, delta)
    assert powers.fal_3_4(zone, 0, LOW) == fal_3_4(LOW, delta)


def test_fal_is_never_beyond_e():
    """Next to a delta of 31 bits the logarithm's LSB is 256 of fal's."""
    delta = 1_073_742_591
    for signed in (1, -1):
        assert powers.fal_3_4([delta, log2(delta)], 0, signed * (delta + 1)) == signed * (delta + 1)


def test_a_zones_logarithm_stands_behind_it():
    assert powers.octaves_beyond([7, 7, 16, 2 << 22, 7], 2, -64) == 4 << 22
    assert powers.fal_3_4([7, 7, 16, 4 << 22, 7], 2, -16 * 16) == -16 * 8


@pytest.mark.parametrize(
    ("convert", "factor"),
    [
        (units.metres_from_setpoint, Fraction(2**31, 10**7)),
        (units.metres_from_position, Fraction(2**31, 10**6)),
        (units.velocity_from_speed, Fraction(120 / math.pi) / 2**20),
        (units.speed_from_velocity, Fraction(math.pi / 120) * 2**20),
    ],
)
def test_factors_of_the_units_are_right_to_31_bits(convert, factor):
    for value in (1, -1, 12, 1000, 123_456, 4_000_000, 329_853_488, 2**30):
        for signed in (value, -value):
            exact = signed * factor
            assert abs(convert(signed) - clip(exact)) <= Fraction(1, 2) + abs(exact) * Fraction(1, 2**31)


@pytest.mark.parametrize(
    ("convert", "factor"),
    [
        (units.metres_from_setpoint, Fraction(2**31, 10**7)),
        (units.metres_from_position, Fraction(2**31, 10**6)),
        (units.speed_from_velocity, Fraction(math.pi / 120) * 2**20),
    ],
)
def test_factors_are_the_nearest_there_are(convert, factor):
    """At full scale, where the factor's rounding to 31 bits adds up to an LSB at most."""
    largest = math.floor(HIGH / factor) - 1
    bits = 31 - math.ceil(math.log2(factor))
    rounding = abs(half_up(factor * 2**bits) / Fraction(2**bits) - factor)
    for value in range(largest - 300, largest):
        for signed in (value, -value):
            assert abs(convert(signed) - signed * factor) <= Fraction(1, 2) + value * rounding


# the paper's ADRC


def switching_error(x1, a0, d):
    """a of eq. 19 in integers, the root floored."""
    y = clip(x1 + a0, -(2**34), 2**34)
    a = a0 + y
    if abs(y) > d:
        a = a0 + int(math.copysign((math.isqrt(d * (d + 8 * abs(y))) - d) // 2, y))
    return clip(a, -d, d)


@pytest.mark.parametrize("d", [1, 2, 7, 1000, 10_737_418])
def test_the_switching_error_is_the_one_of_eq_19(d):
    for x1 in (0, 1, -1, 2, d - 1, d, d + 1, -d, -d - 1, 3 * d, 50 * d, 2**34, -(2**35), 2**36):
        for a0 in (0, 1, -1, d // 3, -d // 2, d, -2 * d, 2**33, -(2**34)):
            assert td.switching_error(x1, a0, d) == switching_error(x1, a0, d)


@pytest.mark.parametrize("side", [1, -1])
def test_beyond_a_metre_the_error_counts_as_one_metre(side):
    d = 2**25
    a0 = -side * ((math.isqrt(d * (d + 8 * 2**34)) - d) // 2 + 1000)
    assert td.switching_error(side * 2**36, a0, d) == -side * 1000


@CASES
def test_tracking_differentiator(seed):
    case = Case(seed)
    v1, v2 = case.before[k.ST_V1], case.before[k.ST_V2]
    error = (v1 - case.setpoint) * 2**3
    missed = switching_error(error, case.gain(k.CAL_TD_H, v2), case.words[k.CAL_TD_D])
    a = -case.gain(k.CAL_TD_K, missed)
    td.td_step(case.words, case.state, case.setpoint)
    case.assert_became(V1=v1 + to(v2, "v", "x"), V2=v2 + to(a, "a", "v"), V3=a)


@CASES
def test_extended_state_observer(seed):
    case = Case(seed)
    z1, z2, z3, z4 = case.before[k.ST_Z1 : k.ST_Z4 + 1]
    delta = case.words[k.CAL_ESO_DELTA]
    e = z1 - case.position
    e_1_4 = fal(e, delta, 0.25)
    e_1_8 = fal(e, delta, 0.125)
    model = case.gain(k.CAL_ESO_A1, z2) + case.gain(k.CAL_ESO_A2, z3) + to(z4, "j", "a")
    drive = case.gain(k.CAL_ESO_B0, case.before[k.ST_U])
    eso.eso_step(case.words, case.state, case.position)
    case.assert_became(
        Z1=z1 + to(z2, "v", "x") - case.gain(k.CAL_ESO_BETA1, e),
        Z2=z2 + to(z3, "a", "v") - case.gain(k.CAL_ESO_BETA2, e),
        Z3=z3 + model + drive - case.gain(k.CAL_ESO_BETA3, e_1_4),
        Z4=z4 - case.gain(k.CAL_ESO_BETA4, e_1_8),
    )


def nonlinear_feedback(case, state):
    v1, v2, v3 = state[k.ST_V1 : k.ST_V3 + 1]
    z1, z2, z3, z4 = state[k.ST_Z1 : k.ST_Z4 + 1]
    e1 = v1 + case.gain(k.CAL_LEAD_V1, v2) - z1
    e2 = v2 + case.gain(k.CAL_LEAD_V2, v3) - z2
    e3 = v3 - z3
    u0 = sum(
        case.gain(index, fal_3_4(e, case.words[delta]))
        for index, e, delta in (
            (k.CAL_FB_K1, e1, k.CAL_FB_DELTA1),
            (k.CAL_FB_K2, e2, k.CAL_FB_DELTA2),
            (k.CAL_FB_K3, e3, k.CAL_FB_DELTA3),
        )
    )
    return u0 - case.gain(k.CAL_FB_A1, z2) - case.gain(k.CAL_FB_A2, z3) - case.gain(k.CAL_FB_Z4, z4)


@CASES
def test_nonlinear_feedback(seed):
    case = Case(seed)
    assert nfcl.nfcl(case.words, case.state) == nonlinear_feedback(case, case.before)
    assert not case.changed()


@CASES
def test_adrc_differentiates_observes_feeds_back(seed):
    case, parts = Case(seed), Case(seed)
    td.td_step(parts.words, parts.state, parts.setpoint)
    eso.eso_step(parts.words, parts.state, parts.position)
    wanted = adrc.adrc_step(case.words, case.state, case.setpoint, case.position)
    assert (wanted, case.state) == (nonlinear_feedback(parts, parts.state), parts.state)


# front end, PI, command filter


def model_speed(case, velocity):
    return case.gain(k.CAL_FRONT_EXTEND if velocity > 0 else k.CAL_FRONT_RETRACT, velocity)


def feed_forward(case, state):
    return model_speed(case, state[k.ST_V2] + case.gain(k.CAL_FRONT_LEAD, state[k.ST_V3]))


@pytest.mark.parametrize("velocity", [-5, -1, 0, 1, 5, 10**6])
def test_the_speed_for_a_motion_is_its_directions(velocity):
    case = Case(3)
    assert front_end.model_speed(case.words, velocity) == model_speed(case, velocity)


@CASES
def test_front_end(seed):
    case = Case(seed)
    v2 = case.before[k.ST_LIMITER_RATE] * 2**7
    smooth = case.before[k.ST_V2_SMOOTH]
    v3 = case.gain(k.CAL_FRONT_SMOOTH, v2 - smooth)
    front_end.front_end_step(case.words, case.state, case.setpoint)
    case.assert_became(V1=case.setpoint, V2=v2, V3=v3, V2_SMOOTH=smooth + to(v3, "a", "v"))
    assert front_end.feed_forward(case.words, case.state) == feed_forward(case, case.state)


@CASES
def test_p(seed):
    case = Case(seed)
    wanted = case.gain(k.CAL_P_KP, case.setpoint - case.position)
    assert pi.p_step(case.words, case.setpoint, case.position) == wanted


@pytest.mark.parametrize("beyond", [-2, -1, 0, 1, 2])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("e", [-1, 0, 1])
def test_the_integral_grows_unless_the_command_is_at_its_limit_and_the_error_drives_it_on(beyond, side, e):
    case = Case(0)
    case.words[k.CAL_PI_KP : k.CAL_PI_KP + 2] = [2**29, 29]
    case.words[k.CAL_PI_KI : k.CAL_PI_KI + 2] = [7 * 2**29, 29]
    limit = case.words[k.CAL_U_LIMIT]
    feedforward = 1000
    integral = side * (limit + beyond) - e - feedforward
    case.state[k.ST_INTEGRAL] = case.before[k.ST_INTEGRAL] = integral
    wound_up = beyond >= 0 and e * side >= 0
    grown = integral if wound_up else integral + 7 * e
    wanted = pi.pi_step(case.words, case.state, case.position + e, case.position, feedforward)
    assert wanted == e + feedforward + grown
    case.assert_became(INTEGRAL=grown)


@CASES
def test_pi_with_feed_forward(seed):
    case, parts = Case(seed), Case(seed)
    front_end.front_end_step(parts.words, parts.state, parts.setpoint)
    known = feed_forward(parts, parts.state)
    expected = pi.pi_step(parts.words, parts.state, parts.setpoint, parts.position, known)
    assert pi.pi_ff_step(case.words, case.state, case.setpoint, case.position) == expected
    assert case.state == parts.state


@CASES
def test_command_filter(seed):
    case = Case(seed)
    last, limit = case.before[k.ST_COMMAND], 900_000
    case.words[k.CAL_U_LIMIT], case.words[k.CAL_COMMAND_SLEW] = limit, 400_000
    for wanted in (10**6, -(10**6), last + 3, HIGH, LOW):
        case.state = list(case.before)
        change = case.gain(k.CAL_COMMAND_SMOOTH, clip(wanted - last))
        command = last + clip(change, -400_000, 400_000)
        assert command_filter.command_filter_step(case.words, case.state, wanted) == command
        case.assert_became(COMMAND=clip(command, -limit, limit))


# the scheduled law


def columns(words, position):
    x = clip(position, 0, words[k.CAL_STROKE])
    length_a = x + words[k.CAL_STIFFNESS_END_A]
    length_b = words[k.CAL_STROKE] - x + words[k.CAL_STIFFNESS_END_B]
    return [
        (words[k.CAL_STIFFNESS_A], length_a),
        (words[k.CAL_STIFFNESS_B], length_b),
    ]


def stiffness(words, position):
    return clip(
        sum(math.floor(Fraction(share * 2**24, length)) for share, length in columns(words, position))
    )


@pytest.mark.parametrize("position_mm", [-100, -1, 0, 1, 100, 200, 399, 400, 401, 900])
def test_stiffness_is_that_of_the_columns(position_mm):
    words = Case(0).words
    words[k.CAL_STROKE] -= words[k.CAL_STROKE] % 2
    position = round(position_mm * 1e-3 * 2**31)
    assert schedule.stiffness(words, position) == stiffness(words, position)


@pytest.mark.parametrize(
    ("length", "expected"), [(0, HIGH), (1, 5 * 2**24), (2, 5 * 2**23), (HIGH, 0), (2**32, 0)]
)
def test_stiffness_of_a_column(length, expected):
    assert schedule.column(5, length) == expected


def test_a_column_counts_with_at_most_a_metre():
    assert schedule.column(HIGH, 2**31 - 2) == 2**24
    assert schedule.column(HIGH, 2**32 - 1) == 2**24


@pytest.mark.parametrize("ratio", [0, 1, 2, 131_071, 131_072, 131_073, 2**24, 22_253_377, HIGH])
def test_softness_is_the_reciprocal(ratio):
    assert schedule.softness(ratio) == (clip(2**48 // ratio) if ratio > 0 else HIGH)


def scaled(value, ratio):
    return half_up(Fraction(value * ratio, 2**24))


@CASES
def test_scheduled_observer(seed):
    case = Case(seed)
    stiff, soft = 3 * 2**23 + 12_345, 2**23 + 6789
    z1, z2, z3 = case.before[k.ST_Z1 : k.ST_Z3 + 1]
    w, motor = case.before[k.ST_DISTURBANCE], case.before[k.ST_MOTOR]
    e = z1 - case.position
    motor += case.gain(k.CAL_SCHEDULED_MOTOR, case.before[k.ST_U] - motor)
    drive = motor + w - model_speed(case, z2)
    w -= case.gain(k.CAL_SCHEDULED_BETA4, e) + case.gain(k.CAL_SCHEDULED_BETA4_SOFT, scaled(e, soft))
    jerk = case.gain(k.CAL_SCHEDULED_B0, scaled(drive, stiff))
    scheduled.observe(case.words, case.state, case.position, stiff, soft)
    case.assert_became(
        Z1=z1 + to(z2, "v", "x") - case.gain(k.CAL_SCHEDULED_BETA1, e),
        Z2=z2 + to(z3, "a", "v") - case.gain(k.CAL_SCHEDULED_BETA2, e),
        Z3=z3 + jerk - case.gain(k.CAL_SCHEDULED_BETA3, e),
        Z4=4 * case.gain(k.CAL_SCHEDULED_B0, scaled(w, stiff)),
        MOTOR=motor,
        DISTURBANCE=w,
    )


def linear_feedback(case, state, soft):
    v1, v2 = state[k.ST_V1 : k.ST_V2 + 1]
    z1, z2, z3 = state[k.ST_Z1 : k.ST_Z3 + 1]
    e1, e2 = v1 + to(v2, "v", "x") - z1, v2 - z2
    errors = case.gain(k.CAL_SCHEDULED_K1, e1) + case.gain(k.CAL_SCHEDULED_K2, e2)
    damping = case.gain(k.CAL_SCHEDULED_K3, z3) + case.gain(k.CAL_SCHEDULED_K3_SOFT, scaled(z3, soft))
    return errors - damping + feed_forward(case, state) - state[k.ST_DISTURBANCE]


@CASES
def test_scheduled_feedback(seed):
    case = Case(seed)
    soft = 2**23 + 6789
    expected = linear_feedback(case, case.before, soft)
    assert scheduled.feedback(case.words, case.state, soft) == expected
    assert not case.changed()


@CASES
def test_scheduled_step_uses_the_stiffness_at_the_position(seed):
    case, parts = Case(seed), Case(seed)
    stiff = schedule.stiffness(parts.words, parts.position)
    soft = schedule.softness(stiff)
    front_end.front_end_step(parts.words, parts.state, parts.setpoint)
    scheduled.observe(parts.words, parts.state, parts.position, stiff, soft)
    wanted = scheduled.scheduled_step(case.words, case.state, case.setpoint, case.position)
    assert (wanted, case.state) == (linear_feedback(parts, parts.state, soft), parts.state)


# the setpoint limiter


def approach(gap, brake):
    if abs(gap) <= brake:
        return gap
    return int(math.copysign((math.isqrt(brake * (brake + 8 * abs(gap))) - brake) // 2, gap))


@pytest.mark.parametrize("brake", [1, 2, 10, 2147])
def test_the_approach_stops_in_the_gap(brake):
    for gap in (0, 1, 2, brake - 1, brake, brake + 1, 3 * brake, 7 * brake + 1, 10**6, 2**31):
        for signed in (gap, -gap):
            assert limiter.approach(signed, brake) == approach(signed, brake)
    for gap in range(1, 60 * brake, max(brake // 2, 1)):
        s = limiter.approach(gap, brake)
        assert s * (s + brake) <= 2 * brake * gap or gap <= brake


@pytest.mark.parametrize("motion", [0, 1, -1, 40, 99, 100, 101, -100, -101, 5000])
@pytest.mark.parametrize("gap", [0, 1, -1, 10, 11, 300, -300, 10_000, -10_000])
@pytest.mark.parametrize("rate", [0, 35, -60, 95, -95])
def test_limiter_step(motion, gap, rate):
    limit, slew, brake = 100, 12, 10
    case = Case(0)
    words = case.words
    words[k.CAL_LIMITER_RATE], words[k.CAL_LIMITER_SLEW], words[k.CAL_LIMITER_BRAKE] = limit, slew, brake
    position, last = 70_000, 70_000 + gap
    setpoint = last + motion
    for state in (case.state, case.before):
        state[k.ST_LIMITER_INPUT], state[k.ST_LIMITER_POSITION] = last, position
        state[k.ST_LIMITER_RATE] = rate
    moved = motion if abs(motion) <= limit else 0
    wanted = clip(moved + approach(setpoint - moved - position, brake), -limit, limit)
    new = rate + clip(wanted - rate, -slew, slew)
    assert limiter.limiter_step(words, case.state, setpoint) == position + new
    case.assert_became(LIMITER_INPUT=setpoint, LIMITER_POSITION=position + new, LIMITER_RATE=new)


# the entry points

ALL_STATES = [name.removeprefix("ST_") for name in names("ST_") if name != "ST_SIZE"]
POSITIONS = ("LIMITER_INPUT", "LIMITER_POSITION", "V1", "Z1")


def entry(seed, law):
    case = Case(seed)
    io = [0] * k.IO_SIZE
    io[k.IO_LAW], io[k.IO_SETPOINT], io[k.IO_POSITION] = law, 1_000_300, 100_000
    io[k.IO_TARGET_VELOCITY] = io[k.IO_FLAGS] = io[k.IO_SATURATIONS] = 99
    return case, io


RESETS = {
    "td": (td.td_reset, {"V1": "x", "V2": 0, "V3": 0}),
    "eso": (eso.eso_reset, {"Z1": "x", "Z2": 0, "Z3": 0, "Z4": 0}),
    "adrc": (adrc.adrc_reset, {"V1": "x", "V2": 0, "V3": 0, "Z1": "x", "Z2": 0, "Z3": 0, "Z4": 0}),
    "front_end": (front_end.front_end_reset, {"V1": "x", "V2": 0, "V3": 0, "V2_SMOOTH": 0}),
    "limiter": (limiter.limiter_reset, {"LIMITER_INPUT": "x", "LIMITER_POSITION": "x", "LIMITER_RATE": 0}),
    "pi": (pi.pi_reset, {"INTEGRAL": 0}),
    "scheduled": (scheduled.scheduled_reset, {"MOTOR": 0, "DISTURBANCE": 0}),
    "command_filter": (command_filter.command_filter_reset, {"COMMAND": 0}),
}


@pytest.mark.parametrize("part", RESETS)
def test_each_part_starts_at_rest_and_leaves_the_others_alone(part):
    reset, states = RESETS[part]
    case = Case(0)
    reset(case.state, case.position) if "x" in states.values() else reset(case.state)
    case.assert_became(**{name: case.position if to == "x" else to for name, to in states.items()})


def test_reset_starts_all_laws_at_rest_at_the_position():
    case, io = entry(0, 4)
    case.state[k.ST_SATURATIONS] = 7
    control.control_reset(case.words, case.state, io)
    x = units.metres_from_position(100_000)
    expected = dict.fromkeys(ALL_STATES, 0) | dict.fromkeys(POSITIONS, x) | {"LAW": 4}
    case.assert_became(**expected)
    assert io == [4, 1_000_300, 100_000, 0, 0, 0]


LAW_STEPS = {
    k.LAW_P: lambda c, s, r, x: pi.p_step(c, r, x),
    k.LAW_PI: lambda c, s, r, x: pi.pi_step(c, s, r, x, 0),
    k.LAW_ADRC: adrc.adrc_step,
    k.LAW_PI_FF: lambda c, s, r, x: command_filter.command_filter_step(c, s, pi.pi_ff_step(c, s, r, x)),
    k.LAW_SCHEDULED: lambda c, s, r, x: command_filter.command_filter_step(
        c, s, scheduled.scheduled_step(c, s, r, x)
    ),
    0: lambda c, s, r, x: 0,
    6: lambda c, s, r, x: 0,
}


@pytest.mark.parametrize("law", LAW_STEPS)
def test_each_law_has_its_number(law):
    case, parts = Case(2), Case(2)
    case.state[k.ST_LAW] = parts.state[k.ST_LAW] = law
    wanted = LAW_STEPS[law](parts.words, parts.state, parts.setpoint, parts.position)
    assert control.law_step(case.words, case.state, case.setpoint, case.position) == wanted
    assert case.state == parts.state


@pytest.mark.parametrize(("z1", "flags"), [(0, 0), (HIGH, 4)])
def test_a_state_that_saturates_is_flagged_in_its_tick(z1, flags):
    case = Case(0)
    for index in GAINS:
        case.words[index] = 0
    case.state = [0] * k.ST_SIZE
    case.state[k.ST_LAW], case.state[k.ST_SATURATIONS] = k.LAW_ADRC, 3
    case.state[k.ST_Z1] = case.state[k.ST_Z2] = z1
    io = [0] * k.IO_SIZE
    io[k.IO_LAW] = k.LAW_ADRC
    control.control_step(case.words, case.state, io)
    assert io == [k.LAW_ADRC, 0, 0, 0, flags, 3 + flags // 4]


@pytest.mark.parametrize("law", LAW_STEPS)
@pytest.mark.parametrize("change", [False, True])
def test_a_tick_limits_runs_the_law_clips_and_quantises(law, change):
    case, io = entry(1, law)
    parts, _ = entry(1, law)
    for some in (case, parts):
        some.state[k.ST_LAW] = 9 if change else law
        some.words[k.CAL_U_LIMIT] = 100_000
    x, r = units.metres_from_position(100_000), units.metres_from_setpoint(1_000_300)
    if change:
        cleared = [name for name in ALL_STATES if not name.startswith("LIMITER") and name not in ("LAW", "U")]
        for name in cleared:
            parts.state[getattr(k, "ST_" + name)] = x if name in POSITIONS else 0
    parts.state[k.ST_LAW] = law
    parts.state[k.ST_SATURATIONS] = case.state[k.ST_SATURATIONS] = 5
    limited = limiter.limiter_step(parts.words, parts.state, r)
    wanted = LAW_STEPS[law](parts.words, parts.state, limited, x)
    velocity = half_up(Fraction(clip(wanted, -100_000, 100_000)) * Fraction(120 / math.pi) / 2**20)
    parts.state[k.ST_U] = half_up(velocity * Fraction(math.pi / 120) * 2**20)
    control.control_step(case.words, case.state, io)
    assert case.state == parts.state
    flags = (abs(wanted) > 100_000) + 2 * (limited != r) + 4 * (parts.state[k.ST_SATURATIONS] != 5)
    assert io == [law, 1_000_300, 100_000, velocity, flags, parts.state[k.ST_SATURATIONS]]
