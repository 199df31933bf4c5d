"""Receive mailboxes: the newest frame of each id, its E2E check, its signals, how long it has been missing.

`receive` (receive interrupt) writes a mailbox, `poll` (timer interrupt) reads it. A mailbox begins at index
`mailbox` of `mailboxes`, what is expected of its message at index `expected` of `contract`.
"""

from dbc.machine import Array32, i32, int32
from dbc.profile2 import DLC, INITIAL, profile2_check, profile2_is_accepted
from firmware_py.signals import extract
from firmware_py.task_layout import (
    AGE,
    ARRIVED,
    CANDIDATES,
    CORRUPT,
    COUNT_MAX,
    CYCLE_PERIODS,
    FIELD_COUNT,
    FIELD_SIZE,
    FIELDS,
    HIGH,
    INVALID,
    IS_NEW,
    LENGTH,
    LOW,
    MAILBOX_SIZE,
    MAX_FIELDS,
    OVERRUNS,
    PHASE,
    STALE,
    STALE_PERIODS,
    VALUES,
)


def clear(mailboxes: Array32, mailbox: int32, contract: Array32, expected: int32) -> None:
    """Begin as at power-on: nothing received, stale."""
    for word in range(MAILBOX_SIZE):
        mailboxes[mailbox + word] = 0
    mailboxes[mailbox + STALE] = 1
    mailboxes[mailbox + AGE] = contract[expected + STALE_PERIODS]


def take(mailboxes: Array32, mailbox: int32, length: int32, low: int32, high: int32) -> None:
    """Store a frame of `length` bytes; one that has not been read is overwritten, and counted."""
    if mailboxes[mailbox + ARRIVED] != 0 and mailboxes[mailbox + OVERRUNS] < COUNT_MAX:
        mailboxes[mailbox + OVERRUNS] = i32(mailboxes[mailbox + OVERRUNS] + 1)
    mailboxes[mailbox + ARRIVED] = 1
    mailboxes[mailbox + LOW] = low
    mailboxes[mailbox + HIGH] = high
    mailboxes[mailbox + LENGTH] = length


def take_values(mailboxes: Array32, mailbox: int32, contract: Array32, expected: int32) -> None:
    """Extract the signals; use them only if all are plausible."""
    low = mailboxes[mailbox + LOW]
    high = mailboxes[mailbox + HIGH]
    mailboxes[mailbox + INVALID] = 0
    field = expected + FIELDS
    number = 0
    while number < contract[expected + FIELD_COUNT]:
        value = extract(low, high, contract[field], contract[field + 1], contract[field + 2])
        mailboxes[mailbox + CANDIDATES + number] = value
        if value < contract[field + 3] or value > contract[field + 4]:
            mailboxes[mailbox + INVALID] = 1
        field = field + FIELD_SIZE
        number = number + 1
    if mailboxes[mailbox + INVALID] == 0:
        for word in range(MAX_FIELDS):
            mailboxes[mailbox + VALUES + word] = mailboxes[mailbox + CANDIDATES + word]
        mailboxes[mailbox + IS_NEW] = 1
        mailboxes[mailbox + AGE] = 0
        mailboxes[mailbox + PHASE] = 0


def poll(mailboxes: Array32, mailbox: int32, contract: Array32, expected: int32) -> None:
    """Check what arrived since the last period. A frame of a wrong length is none to the E2E check."""
    has_arrived = mailboxes[mailbox + ARRIVED]
    is_frame = has_arrived
    if mailboxes[mailbox + LENGTH] != contract[expected + DLC]:
        is_frame = 0
    mailboxes[mailbox + IS_NEW] = 0
    if mailboxes[mailbox + AGE] < contract[expected + STALE_PERIODS]:
        mailboxes[mailbox + AGE] = i32(mailboxes[mailbox + AGE] + 1)
    phase = mailboxes[mailbox + PHASE] + 1
    if phase >= contract[expected + CYCLE_PERIODS]:
        phase = 0
    mailboxes[mailbox + PHASE] = phase
    if has_arrived != 0 or phase == 0:
        low = mailboxes[mailbox + LOW]
        high = mailboxes[mailbox + HIGH]
        status = profile2_check(mailboxes, mailbox, contract, expected, low, high, is_frame)
        is_accepted = profile2_is_accepted(status)
        if has_arrived != 0:
            mailboxes[mailbox + CORRUPT] = 1
            if is_accepted != 0 or status == INITIAL:
                mailboxes[mailbox + CORRUPT] = 0
        if is_accepted != 0:
            take_values(mailboxes, mailbox, contract, expected)
    mailboxes[mailbox + ARRIVED] = 0
    mailboxes[mailbox + STALE] = 0
    if mailboxes[mailbox + AGE] >= contract[expected + STALE_PERIODS]:
        mailboxes[mailbox + STALE] = 1
