"""The calibration block survives the round trip and refuses what is damaged."""

import dataclasses

import pytest
from damaged_blocks import BLOCK, DAMAGED, ILLEGAL_WORDS
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.calibration import VALUE_RANGES, Calibration, CalibrationError
from firmware_py.calibration_block import GAINS, ZONES
from firmware_py.kernel import layout as k
from firmware_py.tuning import Tuning


def test_round_trip():
    calibration = Tuning(law=k.LAW_PI).calibration()
    assert Calibration.from_bytes(calibration.to_bytes()) == calibration
    assert calibration.array().tolist() == list(calibration.words)


@pytest.mark.parametrize(("block", "message"), DAMAGED)
def test_a_wrong_block_is_refused_in_one_line(block, message):
    with pytest.raises(CalibrationError, match=message) as caught:
        Calibration.from_bytes(block)
    assert "\n" not in str(caught.value)


@given(bit=st.integers(0, 8 * len(BLOCK) - 1))
def test_any_flipped_bit_is_noticed(bit):
    damaged = bytearray(BLOCK)
    damaged[bit // 8] ^= 1 << bit % 8
    # the two reserved bytes are covered by the CRC as well
    with pytest.raises(CalibrationError):
        Calibration.from_bytes(bytes(damaged))


@pytest.mark.parametrize(("index", "word", "message"), ILLEGAL_WORDS)
def test_an_illegal_word_is_refused(index, word, message):
    calibration = Tuning().calibration()
    words = list(calibration.words)
    words[index] = word
    with pytest.raises(CalibrationError, match=message):
        dataclasses.replace(calibration, words=tuple(words))


def test_every_word_has_a_legal_range():
    others = {index + offset for index in GAINS for offset in (0, 1)} | {index + 1 for index in ZONES}
    assert others | VALUE_RANGES.keys() == set(range(k.CAL_SIZE))
    assert others.isdisjoint(VALUE_RANGES)
