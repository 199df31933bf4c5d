"""The DataID lists of the packaged contract: which errors of a protected payload go undetected."""

import random
from itertools import chain, combinations

import numpy as np
import pytest

from dbc import dataid_search
from dbc.contract import Contract

PROTECTED = [message for message in Contract.load().messages if message.data_ids]
CARELESS = tuple(range(16))
MAX_BIT_ERRORS = 3
RANDOM_PAYLOADS = 3

every_protected = pytest.mark.parametrize("message", PROTECTED, ids=lambda message: message.name)


def crc8h2f_table():
    table = np.arange(256, dtype=np.uint8)
    for _ in range(8):
        table = (table << 1) ^ np.where(table & 0x80, 0x2F, 0).astype(np.uint8)
    return table


def is_valid(payloads, dlc, data_ids):
    """Vectorised profile-2 check, written apart from `dbc.e2e`: CRC over bytes 1.. and the DataID."""
    table = crc8h2f_table()
    payload_bytes = [
        (payloads >> np.uint64(8 * index) & np.uint64(0xFF)).astype(np.uint8) for index in range(dlc)
    ]
    crc = np.full(len(payloads), 0xFF, dtype=np.uint8)
    for byte in [*payload_bytes[1:], np.array(data_ids, dtype=np.uint8)[payload_bytes[1] & 0xF]]:
        crc = table[crc ^ byte]
    return (crc ^ 0xFF) == payload_bytes[0]


def error_patterns(dlc, max_bits):
    """Every pattern of one to `max_bits` flipped bits in a payload."""
    flips = chain.from_iterable(combinations(range(8 * dlc), number) for number in range(1, max_bits + 1))
    return np.array([sum(1 << bit for bit in bits) for bits in flips], dtype=np.uint64)


def undetected(dlc, data_ids):
    """Count the error patterns that turn a valid payload into another valid one, over all counter values."""
    rng = np.random.default_rng(1)
    patterns = error_patterns(dlc, MAX_BIT_ERRORS)
    total = 0
    for counter in range(16):
        bodies = rng.integers(0, 1 << (8 * dlc - 12), RANDOM_PAYLOADS, dtype=np.uint64)
        for body in bodies:
            with_any_crc = body << np.uint64(12) | np.uint64(counter << 8) | np.arange(256, dtype=np.uint64)
            (payload,) = with_any_crc[is_valid(with_any_crc, dlc, data_ids)]
            total += int(is_valid(payload ^ patterns, dlc, data_ids).sum())
    return total


@every_protected
def test_every_error_of_up_to_three_bits_is_detected(message):
    assert undetected(message.dlc, message.data_ids) == 0


def test_a_careless_list_lets_errors_through():
    """The reason for the search, and the proof that the enumeration above can fail."""
    assert undetected(6, CARELESS) > 0


@every_protected
def test_search_calls_exactly_the_undetected_errors_hidden(message):
    hidden = dataid_search.hidden_differences(message.dlc)

    def clashes(data_ids):
        pairs = [(a, b) for a in range(16) for b in range(16) if a != b]
        return any(data_ids[a] ^ data_ids[b] in hidden[a ^ b] for a, b in pairs)

    assert not clashes(message.data_ids)
    assert clashes(CARELESS)


def test_no_message_passes_for_another():
    """All ids differ, so that at equal counters the CRCs of two messages' equal payloads differ."""
    data_ids = [data_id for message in PROTECTED for data_id in message.data_ids]
    assert len(data_ids) == len(set(data_ids)) == 16 * len(PROTECTED)


def test_the_tool_prints_the_lists_of_the_contract(capsys):
    dataid_search.main()
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert printed == {message.name: ",".join(map(str, message.data_ids)) for message in PROTECTED}


def test_too_few_ids_left_is_an_error():
    with pytest.raises(ValueError, match="no DataID list for 6 bytes"):
        dataid_search.find_data_ids(6, set(range(5, 256)), random.Random(0))
