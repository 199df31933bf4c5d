"""Signals in a payload of two words, wherever they lie, against shifts of one big integer."""

import pytest

from firmware_py import signals
from firmware_py import task_layout as at

VALUES = (0, 1, -1, 0x5A5A_5A5A, -0x1234_5678, 2**31 - 1, -(2**31))
OTHERS = [77] * 5


def words(payload):
    """Low and high word, as signed 32-bit integers."""
    return [(payload >> shift & 0xFFFF_FFFF ^ 1 << 31) - (1 << 31) for shift in (0, 32)]


@pytest.mark.parametrize("length", [1, 2, 7, 8, 16, 31])
def test_insert_sets_the_signals_bits_and_no_others(length):
    for start in range(65 - length):
        mask = (1 << length) - 1 << start
        contract = [*OTHERS, start, length, *OTHERS]
        for value in VALUES:
            for before in (0, (1 << 64) - 1 & ~mask):
                frames = [*OTHERS, 1, 2, *words(before), *OTHERS]
                signals.insert(frames, 5, contract, 5, value)
                assert frames == [*OTHERS, 1, 2, *words(before | value << start & mask), *OTHERS]


@pytest.mark.parametrize("length", [1, 2, 7, 8, 16, 31])
def test_extract_reads_what_insert_wrote_signed_or_not(length):
    for start in range(65 - length):
        for value in VALUES:
            raw = value & (1 << length) - 1
            payload = raw << start | (0x0F0F_F0F0_1234_8765 & ~((1 << length) - 1 << start))
            signed = raw - (1 << length) * (raw >> length - 1)
            assert signals.extract(*words(payload), start, length, 0) == raw
            assert signals.extract(*words(payload), start, length, 1) == signed


@pytest.mark.parametrize("value", VALUES)
def test_signed_signals_may_fill_a_word(value):
    for start in (0, 1, 16, 31, 32):
        low, high = words((value & 0xFFFF_FFFF) << start)
        assert signals.extract(low, high, start, 32, 1) == value


def test_begin_takes_identifier_and_length_and_empties_the_payload():
    contract = [*OTHERS, 0x321, 6, *OTHERS]
    frames = [*OTHERS, *[9] * at.FRAME_SIZE, *OTHERS]
    signals.begin(frames, 5, contract, 5)
    assert frames == [*OTHERS, 0x321, 6, 0, 0, *OTHERS]
