"""Fault confinement (ISO 11898-1, 10.11): error counters, error-passive and bus-off nodes, their recovery.

Every error is global: the transmitter sees it and so does every receiver, at the same bit. What only some
nodes see is not modelled, nor is a frame that nobody acknowledges. All functions work on the words of ports.
"""

import math

import numpy as np
from numba.extending import register_jitable

TEC, REC, SEQUENCES_LEFT, SUSPENDED_UNTIL = range(6, 10)
"""Transmit and receive error counter; of a bus-off node the sequences of 11 recessive bits that it still
waits for, else 0; bus time until which an error-passive transmitter lets others go first, ns."""

ERROR_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8
SUSPEND_BITS = 8
RECOVERY_SEQUENCES = 128
SEQUENCE_BITS = 11

PASSIVE_FROM = 128
BUS_OFF_FROM = 256
_TRANSMIT_STEP = 8
_BACK_TO_ACTIVE = 127


@register_jitable
def is_passive(port):  # type: ignore[no-untyped-def]
    """Tell whether a node is error-passive."""
    return port[TEC] >= PASSIVE_FROM or port[REC] >= PASSIVE_FROM


@register_jitable
def after_error(ports, count, sender):  # type: ignore[no-untyped-def]
    """Count a destroyed frame; return whether its sender is bus-off from now on."""
    for number in range(count):
        port = ports[number]
        if port[SEQUENCES_LEFT]:
            continue
        if number == sender:
            port[TEC] += _TRANSMIT_STEP
        elif port[REC] < BUS_OFF_FROM - 1:
            port[REC] += 1
    if sender < count and ports[sender, TEC] >= BUS_OFF_FROM:
        ports[sender, SEQUENCES_LEFT] = RECOVERY_SEQUENCES
        return True
    return False


@register_jitable
def after_success(ports, count, sender):  # type: ignore[no-untyped-def]
    """Count a frame that arrived."""
    for number in range(count):
        port = ports[number]
        if port[SEQUENCES_LEFT]:
            continue
        if number == sender:
            port[TEC] = max(port[TEC] - 1, 0)
        else:
            port[REC] = min(max(port[REC] - 1, 0), _BACK_TO_ACTIVE)


@register_jitable
def count_sequences(ports, count, sequences):  # type: ignore[no-untyped-def]
    """Let bus-off nodes see sequences of 11 recessive bits; return whether one still waits."""
    waiting = False
    for number in range(count):
        port = ports[number]
        if port[SEQUENCES_LEFT]:
            port[SEQUENCES_LEFT] = max(port[SEQUENCES_LEFT] - sequences, 0)
            if port[SEQUENCES_LEFT]:
                waiting = True
            else:
                port[TEC] = port[REC] = 0
    return waiting


@register_jitable
def next_random(state):  # type: ignore[no-untyped-def]
    """Return the state after the next step of SplitMix64, and a number above 0 and below 1."""
    word = state + np.uint64(0x9E3779B97F4A7C15)
    mixed = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed ^= mixed >> np.uint64(31)
    return word, (np.float64(mixed >> np.uint64(11)) + 0.5) / 2.0**53


@register_jitable
def first_bad_bit(uniform, bad_bits_per_billion):  # type: ignore[no-untyped-def]
    """Return how many good bits come before the first bad one, from a uniform number in (0, 1)."""
    return np.int64(math.log(uniform) / math.log1p(-bad_bits_per_billion * 1e-9))
