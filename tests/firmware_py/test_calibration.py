"""The calibration block survives the round trip and refuses what is damaged."""

import dataclasses
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.calibration import GAINS, VALUE_RANGES, ZONES, Calibration, CalibrationError
from firmware_py.kernel import layout as k
from firmware_py.tuning import Tuning

BLOCK = Tuning().calibration().to_bytes()


def resealed(block: bytes) -> bytes:
    """`block` with a fitting CRC."""
    return block[:-4] + struct.pack("<I", zlib.crc32(block[:-4]))


def test_round_trip():
    calibration = Tuning(law=k.LAW_PI).calibration()
    assert Calibration.from_bytes(calibration.to_bytes()) == calibration
    assert calibration.array().tolist() == list(calibration.words)


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (b"", r"calibration: magic b'' instead of b'DDHC'"),
        (b"XXXX" + BLOCK[4:], r"calibration: magic b'XXXX' instead of b'DDHC'"),
        (BLOCK[:8], r"calibration: 8 bytes are too short for the header"),
        (resealed(BLOCK[:4] + b"\x63\x00" + BLOCK[6:]), r"calibration: layout version 99 instead of 3"),
        (BLOCK[:-1], r"calibration: 91 words in 379 bytes instead of 91 in 380"),
        (BLOCK + b"\0", r"calibration: 91 words in 381 bytes instead of 91 in 380"),
        (resealed(BLOCK[:8] + b"\x5a" + BLOCK[9:]), r"calibration: 90 words in 380 bytes"),
        (BLOCK[:-4] + b"\0\0\0\0", r"calibration: CRC 0x00000000 instead of 0x"),
        (resealed(BLOCK[:6] + b"\x09" + BLOCK[7:]), r"calibration: unknown control law 9"),
        (resealed(BLOCK[:12] + b"\0\0\0\0" + BLOCK[16:]), r"calibration: CAL_U_LIMIT = 0 outside 1\.\."),
    ],
)
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


@pytest.mark.parametrize(
    ("index", "word", "message"),
    [
        (k.CAL_TD_D, 0, "CAL_TD_D = 0 outside 1..33554432"),
        (k.CAL_FB_K1 + 1, 7, "CAL_FB_K1 shift = 7 outside 8..62"),
        (k.CAL_FB_K1 + 1, 63, "CAL_FB_K1 shift = 63 outside 8..62"),
        (k.CAL_FB_K1, -(2**31), "CAL_FB_K1 = -2147483648 outside -2147483647..2147483647"),
        (k.CAL_ESO_DELTA, 0, "CAL_ESO_DELTA = 0 outside 1..2147483647"),
        (k.CAL_ESO_DELTA, 2**17, r"CAL_ESO_DELTA log2 = \d+ outside 71303168..71303168"),
        (k.CAL_FB_DELTA3 + 1, 0, r"CAL_FB_DELTA3 log2 = 0 outside \d+"),
        (k.CAL_LIMITER_BRAKE, 2**24 + 1, "CAL_LIMITER_BRAKE = 16777217 outside 1..16777216"),
    ],
)
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
