"""Receive mailboxes: the newest frame of each id, its E2E check, its signals, how long it has been missing.

A mailbox is a row of an int64 array that `receive` (receive interrupt) writes and `poll` (timer interrupt)
reads; what it expects of its message is another row. Both functions are compiled.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numba.extending import register_jitable

from dbc import e2e
from dbc.codec import MessageCodec
from dbc.jit import njit
from dbc.node import PERIOD_NS

STALE_CYCLES = 3
"""Cycles of a message without valid data after which it counts as lost."""

MAX_FIELDS = 3

# mailbox row: the receiver's E2E state, then
ARRIVED = e2e.STATE_SIZE + 0  # frames since the last poll
DATA = e2e.STATE_SIZE + 1  # payload of the newest, at most 63 bits
LENGTH = e2e.STATE_SIZE + 2  # its number of bytes
IS_NEW = e2e.STATE_SIZE + 3  # whether the last poll brought a valid frame
AGE = e2e.STATE_SIZE + 4  # periods since the last valid frame
STALE = e2e.STATE_SIZE + 5  # whether AGE has reached the limit
CORRUPT = e2e.STATE_SIZE + 6  # whether the last frame failed its E2E check
INVALID = e2e.STATE_SIZE + 7  # whether the last intact frame was not plausible
OVERRUNS = e2e.STATE_SIZE + 8  # frames overwritten before they were read
CANDIDATES = e2e.STATE_SIZE + 9  # signals of the newest intact frame
VALUES = CANDIDATES + MAX_FIELDS  # signals of the newest valid frame
MAILBOX_SIZE = VALUES + MAX_FIELDS

# expectation row: the receiver's E2E configuration, then
CYCLE_PERIODS = e2e.CONFIGURATION_SIZE + 0
FIELD_COUNT = e2e.CONFIGURATION_SIZE + 1
FIELDS = (
    e2e.CONFIGURATION_SIZE + 2
)  # of each field: start, length, sign bit, lowest and highest plausible value
FIELD_SIZE = 5
EXPECTATION_SIZE = FIELDS + MAX_FIELDS * FIELD_SIZE

_FIRST = int(e2e.Status.INITIAL)


def expectation(message: MessageCodec[..., Any], plausible: Mapping[str, tuple[int, int]]) -> np.ndarray:
    """Return the expectation row of a protected message.

    Parameters
    ----------
    message : MessageCodec
        The message; its cycle time sets the staleness limit.
    plausible : mapping of str to (int, int)
        Lowest and highest raw value of a field that may be used; of a field not named, all are.
    """
    row = np.zeros(EXPECTATION_SIZE, np.int64)
    row[: e2e.CONFIGURATION_SIZE] = message.receiver_configuration()
    row[CYCLE_PERIODS] = max(message.cycle_time_ns // PERIOD_NS, 1)
    row[FIELD_COUNT] = len(message.fields)
    for number, field in enumerate(message.fields):
        low, high = plausible.get(field.name, (field.minimum, field.minimum + field.mask))
        first = FIELDS + number * FIELD_SIZE
        row[first : first + FIELD_SIZE] = field.start, field.length, -field.minimum, low, high
    return row


def empty(expectations: np.ndarray) -> np.ndarray:
    """Return the mailboxes at power-on: nothing received, everything stale."""
    mailboxes = np.zeros((len(expectations), MAILBOX_SIZE), np.int64)
    mailboxes[:, STALE] = 1
    mailboxes[:, AGE] = [STALE_CYCLES * row[CYCLE_PERIODS] for row in expectations]
    return mailboxes


@njit("void(int64[::1], uint64, int64)")
def receive(mailbox, data, length):  # type: ignore[no-untyped-def]
    """Store a frame of `length` bytes; one that has not been read is overwritten, and counted."""
    if mailbox[ARRIVED]:
        mailbox[OVERRUNS] += 1
    mailbox[ARRIVED] += 1
    mailbox[DATA] = np.int64(data)
    mailbox[LENGTH] = length


@register_jitable
def _take_values(mailbox, expected):  # type: ignore[no-untyped-def]
    """Extract the signals; use them only if all are plausible."""
    values = mailbox[CANDIDATES:VALUES]
    mailbox[INVALID] = 0
    for number in range(expected[FIELD_COUNT]):
        first = FIELDS + number * FIELD_SIZE
        raw = (mailbox[DATA] >> expected[first]) & ((1 << expected[first + 1]) - 1)
        value = (raw ^ expected[first + 2]) - expected[first + 2]
        values[number] = value
        if value < expected[first + 3] or value > expected[first + 4]:
            mailbox[INVALID] = 1
    if not mailbox[INVALID]:
        mailbox[VALUES : VALUES + MAX_FIELDS] = values
        mailbox[IS_NEW] = 1
        mailbox[AGE] = 0


@register_jitable
def poll(mailbox, expected):  # type: ignore[no-untyped-def]
    """Check what arrived since the last period. A frame of a wrong length is none to the E2E check."""
    arrived = mailbox[ARRIVED] and mailbox[LENGTH] == expected[e2e.DLC]
    mailbox[IS_NEW] = 0
    mailbox[AGE] += 1
    if mailbox[ARRIVED] or mailbox[AGE] % expected[CYCLE_PERIODS] == 0:
        status = e2e.profile2_check(
            mailbox[: e2e.STATE_SIZE], expected[: e2e.CONFIGURATION_SIZE], np.uint64(mailbox[DATA]), arrived
        )
        if mailbox[ARRIVED]:
            mailbox[CORRUPT] = status not in e2e.ACCEPTED and status != _FIRST
        if status in e2e.ACCEPTED:
            _take_values(mailbox, expected)
    mailbox[ARRIVED] = 0
    mailbox[STALE] = mailbox[AGE] >= STALE_CYCLES * expected[CYCLE_PERIODS]
