"""At power-on the firmware takes the calibration blocks that the host takes, and no others."""

import struct

import pytest
from damaged_blocks import BLOCK, DAMAGED, ILLEGAL_WORDS, resealed, with_words
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.calibration import Calibration, CalibrationError, flashed
from firmware_py.calibration_block import law_of_block
from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22
from firmware_py.tuning import TUNINGS, Tuning

INT32_MIN, INT32_MAX = -(2**31), 2**31 - 1
LAWS = range(k.LAW_P, k.LAW_SCHEDULED + 1)
SHIFT = (8, 62)
HIGHEST = {
    k.CAL_LIMITER_RATE: 2**24,
    k.CAL_LIMITER_SLEW: 2**24,
    k.CAL_LIMITER_BRAKE: 2**24,
    k.CAL_TD_D: 2**25,
}
"""Of the words without a shift or a logarithm behind them, if it is not the largest number."""

ZONES = (k.CAL_ESO_DELTA, k.CAL_FB_DELTA1, k.CAL_FB_DELTA2, k.CAL_FB_DELTA3)
NAMED = {value for name, value in vars(k).items() if name.startswith("CAL_")}
SHIFTS = {index for index in range(k.CAL_SIZE) if index not in NAMED and index - 1 not in ZONES}
LOGARITHMS = {index + 1 for index in ZONES}


def law_at_power_on(block: bytes) -> int:
    return law_of_block(list(struct.unpack("<95i", flashed(block))))


def law_at_the_host(block: bytes) -> int:
    try:
        return Calibration.from_bytes(block).law
    except CalibrationError:
        return 0


@pytest.mark.parametrize("tuning", TUNINGS.values(), ids=list(TUNINGS))
def test_a_good_block_comes_with_its_law(tuning):
    calibration = tuning.calibration()
    assert law_at_power_on(calibration.to_bytes()) == calibration.law


def test_a_block_begins_with_its_name():
    assert BLOCK[:4] == b"DDHC"


@pytest.mark.parametrize("law", LAWS)
def test_each_law_can_be_the_default_one(law):
    assert law_at_power_on(Tuning(law=law).calibration().to_bytes()) == law


@pytest.mark.parametrize("block", [block for block, _ in DAMAGED])
def test_a_damaged_block_is_refused(block):
    assert law_at_power_on(block) == 0


@pytest.mark.parametrize(
    ("place", "field"),
    [
        (0, b"DDHD"),
        (4, struct.pack("<H", k.LAYOUT_VERSION - 1)),
        (4, struct.pack("<H", k.LAYOUT_VERSION + 0x100)),
        (6, struct.pack("<H", k.LAW_P - 1)),
        (6, struct.pack("<H", k.LAW_SCHEDULED + 1)),
        (6, struct.pack("<H", k.LAW_P + 0x8000)),
        (8, struct.pack("<H", k.CAL_SIZE + 1)),
        (8, struct.pack("<H", k.CAL_SIZE + 0x8000)),
    ],
)
def test_a_header_that_is_not_ours_is_refused_though_the_crc_fits(place, field):
    block = resealed(BLOCK[:place] + field + BLOCK[place + len(field) :])
    assert law_at_power_on(block) == law_at_the_host(block) == 0


def test_the_reserved_half_word_only_has_to_fit_the_crc():
    block = resealed(BLOCK[:10] + b"\x34\x92" + BLOCK[12:])
    assert law_at_power_on(block) == law_at_the_host(block) == Calibration.from_bytes(BLOCK).law


def test_an_erased_flash_is_refused():
    assert law_at_power_on(b"\xff" * len(BLOCK)) == law_at_power_on(bytes(len(BLOCK))) == 0


def test_any_flipped_bit_is_noticed():
    for bit in range(8 * len(BLOCK)):
        damaged = (int.from_bytes(BLOCK, "little") ^ 1 << bit).to_bytes(len(BLOCK), "little")
        assert law_at_power_on(damaged) == 0, bit


@pytest.mark.parametrize(("index", "word"), [(index, word) for index, word, _ in ILLEGAL_WORDS])
def test_an_illegal_word_is_refused_though_the_crc_fits(index, word):
    assert law_at_power_on(with_words({index: word})) == 0


@pytest.mark.parametrize("index", sorted(set(range(k.CAL_SIZE)) - LOGARITHMS - set(ZONES)))
def test_each_word_is_legal_up_to_the_ends_of_its_range(index):
    if index in SHIFTS:
        low, high = SHIFT
    elif index + 1 in SHIFTS:
        low, high = -INT32_MAX, INT32_MAX
    else:
        low, high = 1, HIGHEST.get(index, INT32_MAX)
    words = [word for word in (low - 1, low, high, high + 1) if INT32_MIN <= word <= INT32_MAX]
    taken = [word for word in words if law_at_power_on(with_words({index: word})) != 0]
    assert taken == [low, high]


@pytest.mark.parametrize("index", sorted(LOGARITHMS))
def test_a_logarithm_is_that_of_its_zone(index):
    (word,) = struct.unpack_from("<i", BLOCK, 12 + 4 * index)
    assert [law_at_power_on(with_words({index: word + off})) != 0 for off in (-1, 0, 1)] == [
        False,
        True,
        False,
    ]


@pytest.mark.parametrize("index", ZONES)
def test_a_zone_is_at_least_one(index):
    assert law_at_power_on(with_words({index: 1, index + 1: 0})) != 0
    for half_width in (0, -1, INT32_MIN):
        for logarithm in (0, -(2**22), log2_q22(-1)):  # what the kernel's log2 makes of 0 and -1
            assert law_at_power_on(with_words({index: half_width, index + 1: logarithm})) == 0


@given(index=st.integers(0, k.CAL_SIZE - 1), word=st.integers(INT32_MIN, INT32_MAX))
def test_any_word_in_any_place_is_taken_where_the_host_takes_it(index, word):
    block = with_words({index: word})
    assert law_at_power_on(block) == law_at_the_host(block)
