"""Length of frames on the wire, built bit by bit and independent of the bench."""

import numpy as np


def bit_columns(values, width):
    """Bits of each value, most significant first: one array of all frames' bits per position."""
    return [values >> np.uint64(width - 1 - position) & np.uint64(1) for position in range(width)]


def crc15(columns):
    """CRC-15/CAN, one bit of all frames at a time (ISO 11898-1, 10.4.2.6)."""
    register = np.zeros_like(columns[0])
    for bit in columns:
        feedback = bit ^ register >> np.uint64(14)
        register = register << np.uint64(1) & np.uint64(0x7FFF)
        register = np.where(feedback == 1, register ^ np.uint64(0x4599), register)
    return register


def stuff_bits(columns):
    """Stuff bits per frame: after five equal bits on the wire, stuff bits included, a complementary one."""
    count = np.zeros(len(columns[0]), dtype=np.int64)
    run = np.zeros_like(count)
    level = np.full_like(columns[0], 2)
    for bit in columns:
        run = np.where(bit == level, run + 1, 1)
        stuffed = run == 5
        count += stuffed
        level = np.where(stuffed, 1 - bit, bit)
        run = np.where(stuffed, 1, run)
    return count


def reference_bits(identifiers, extended, dlc, payloads):
    """Length of data frames of one kind, built from the fields of the standard."""
    constant = {value: np.full_like(identifiers, value) for value in (0, 1)}
    if extended:
        arbitration = [
            *bit_columns(identifiers >> np.uint64(18), 11),
            constant[1],
            constant[1],
            *bit_columns(identifiers & np.uint64(0x3FFFF), 18),
            constant[0],
        ]
        control = [constant[0], constant[0]]
    else:
        arbitration = [*bit_columns(identifiers, 11), constant[0]]
        control = [constant[0], constant[0]]
    length_code = bit_columns(np.full_like(identifiers, dlc), 4)
    data = [
        column
        for index in range(dlc)
        for column in bit_columns(payloads >> np.uint64(8 * index) & np.uint64(0xFF), 8)
    ]
    columns = [constant[0], *arbitration, *control, *length_code, *data]
    columns += bit_columns(crc15(columns), 15)
    return len(columns) + stuff_bits(columns) + 1 + 2 + 7 + 3


def reference_fd_bits(identifiers, extended, switched, passive, payloads):
    """Bits up to the switch and behind CRC, and bits between, of CAN FD frames of one kind and length.

    `payloads` has a row of bytes for each frame.
    """
    zero, one = np.zeros_like(identifiers), np.ones_like(identifiers)
    switch = one if switched else zero
    if extended:
        base, extension = identifiers >> np.uint64(18), identifiers & np.uint64(0x3FFFF)
        nominal = [
            zero,
            *bit_columns(base, 11),
            one,
            one,
            *bit_columns(extension, 18),
            zero,
            one,
            zero,
            switch,
        ]
    else:
        nominal = [zero, *bit_columns(identifiers, 11), zero, zero, one, zero, switch]
    length = payloads.shape[1]
    code = bit_columns(np.full_like(identifiers, [*range(9), 12, 16, 20, 24, 32, 48, 64].index(length)), 4)
    data = [column for byte in payloads.T for column in bit_columns(byte.astype(np.uint64), 8)]
    stuffable = [*nominal, passive, *code, *data][:-1]  # what follows the last bit is the fixed stuff bit
    crc_field = 4 + 17 + 6 if length <= 16 else 4 + 21 + 7
    nominal_stuff_bits = stuff_bits(nominal)
    fast_stuff_bits = stuff_bits(stuffable) - nominal_stuff_bits
    return len(nominal) + nominal_stuff_bits + 12, 5 + 8 * length + fast_stuff_bits + crc_field + 1
