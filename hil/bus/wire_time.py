"""Exact length of frames on the wire, in bits, stuff bits included (ISO 11898-1).

Lengths run from the start of frame to the end of the three bits of intermission. Of a CAN FD frame with a bit
rate switch some bits are at the nominal rate and others at the data rate.
"""

from typing import Any

import can
import numpy as np
from can.util import CAN_FD_DLC, dlc2len, len2dlc
from numba.extending import register_jitable
from numpy.typing import NDArray

from dbc.frame import BRS_FLAG, EFF_FLAG, ERR_FLAG, ESI_FLAG, FD_FLAG
from dbc.jit import njit

RTR_FLAG = 0x4000_0000
"""Set in an identifier word for a remote frame, as in SocketCAN's `can_id`."""

INTERMISSION_BITS = 3
ERROR_BITS_BYTE, ERROR_MORE_BITS_BYTE = 5, 4
"""Low and high byte, in an error frame's data in a log, of the bits at the nominal rate from the start of
what it destroyed to its own end; those at the data rate are in bytes 0 and 1."""

FD_LENGTHS = np.array(CAN_FD_DLC)
"""Number of data bytes of each DLC."""

FAST_SHIFT, PAYLOAD_SHIFT, LENGTH_MASK = 10, 20, (1 << 10) - 1
"""Of a CAN FD frame in a log the data word holds its length, bits at the nominal rate lowest, then those at
the data rate, then the row of its payload."""

CRC15_POLYNOMIAL = 0x4599
UNSTUFFED_BITS = 13
"""CRC delimiter, ACK, ACK delimiter, seven bits of end of frame, three of intermission."""


def _crc15_table() -> NDArray[np.int64]:
    """Return the CRC-15 of each byte."""
    crc = np.arange(256, dtype=np.int64) << 7
    for _ in range(8):
        crc = (crc << 1 & 0x7FFF) ^ np.where(crc & 0x4000, CRC15_POLYNOMIAL, 0)
    return crc


def _stuffing_table() -> NDArray[np.int64]:
    """Return, per state and byte, ``stuff bits << 3 | next state``; the index is ``state << 8 | byte``.

    A state is ``(length of the current run of equal bits - 1) << 1 | its level``. A run of five ends at once:
    the stuff bit starts a run of its own.
    """
    state, byte = np.divmod(np.arange(8 * 256, dtype=np.int64), 256)
    run, level = (state >> 1) + 1, state & 1
    stuff_bits = np.zeros_like(state)
    for position in range(7, -1, -1):
        bit = byte >> position & 1
        run = np.where(bit == level, run + 1, 1)
        stuffed = run == 5
        level = bit ^ stuffed
        run[stuffed] = 1
        stuff_bits += stuffed
    return stuff_bits << 3 | (run - 1) << 1 | level


CRC15 = _crc15_table()
STUFFING = _stuffing_table()
AFTER_DOMINANT = 0


@njit("int64(int64, int64, uint64)")
def classic_bits(can_id: int, dlc: int, data: int) -> int:
    """Return the length of a classic frame in bits.

    Parameters
    ----------
    can_id : int
        Identifier; `EFF_FLAG` set for a 29-bit one, `RTR_FLAG` for a remote frame.
    dlc : int
        Number of data bytes, 0..8.
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    """
    remote = 1 if can_id & RTR_FLAG else 0
    # Bits before the start of frame fill the header up to whole bytes: alternating ones for the stuffing,
    # which they do not disturb, and zeros for the CRC.
    if can_id & EFF_FLAG:
        header = (can_id >> 18 & 0x7FF) << 27 | 0b11 << 25 | (can_id & 0x3FFFF) << 7 | remote << 6 | dlc
        header_bits, fill = 39, 0b1 << 39
    else:
        header = (can_id & 0x7FF) << 7 | remote << 6 | dlc
        header_bits, fill = 19, 0b10101 << 19
    data_bits = 0 if remote else 8 * dlc

    crc = 0
    state = AFTER_DOMINANT
    stuff_bits = 0
    for shift in range(header_bits // 8 * 8, -1, -8):
        crc = (crc << 8 & 0x7FFF) ^ CRC15[(crc >> 7) ^ (header >> shift & 0xFF)]
        step = STUFFING[state << 8 | ((header | fill) >> shift & 0xFF)]
        stuff_bits += step >> 3
        state = step & 7
    for shift in range(0, data_bits, 8):
        byte = np.int64(data >> np.uint64(shift)) & 0xFF
        crc = (crc << 8 & 0x7FFF) ^ CRC15[(crc >> 7) ^ byte]
        step = STUFFING[state << 8 | byte]
        stuff_bits += step >> 3
        state = step & 7
    tail = crc << 1 | ((crc & 1) ^ 1)  # the last bit fills up the byte and cannot be stuffed
    step = STUFFING[state << 8 | tail >> 8]
    stuff_bits += step >> 3
    stuff_bits += STUFFING[(step & 7) << 8 | tail & 0xFF] >> 3
    return header_bits + data_bits + 15 + stuff_bits + UNSTUFFED_BITS


def worst_case_bits(can_id: int, dlc: int) -> int:
    """Return the length in bits of a classic data frame that needs as many stuff bits as there can be.

    Parameters
    ----------
    can_id : int
        Identifier; `EFF_FLAG` set for a 29-bit one.
    dlc : int
        Number of data bytes, 0..8.
    """
    stuffed = (54 if can_id & EFF_FLAG else 34) + 8 * dlc
    return stuffed + (stuffed - 1) // 4 + UNSTUFFED_BITS


@register_jitable
def _stuff(bits, count, run, level):  # type: ignore[no-untyped-def]
    """Return the stuff bits of a sequence, most significant bit first, and the last bit's run and level."""
    stuff_bits = 0
    for position in range(count - 1, -1, -1):
        bit = bits >> position & 1
        run = run + 1 if bit == level else 1
        level = bit
        if run == 5:
            stuff_bits += 1
            run, level = 1, 1 - bit
    return stuff_bits, run, level


@njit("UniTuple(int64, 2)(int64, int64, uint64[::1])", depends=("dbc.frame",))
def fd_bits(can_id, length, payload):  # type: ignore[no-untyped-def]
    """Return the length of an ISO CAN FD frame as (bits at the nominal rate, bits at the data rate).

    Without a bit rate switch all bits are at the nominal rate. Dynamic stuffing ends with the data field:
    after five equal bits at its very end the fixed stuff bit of the CRC field takes the dynamic one's place.

    Parameters
    ----------
    can_id : int
        Identifier with its flags, as in `dbc.frame.Frame`.
    length : int
        Number of data bytes, one of `FD_LENGTHS`.
    payload : array of 8 uint64
        Data, byte 0 in the low eight bits of the first.
    """
    switched = 1 if can_id & BRS_FLAG else 0
    if can_id & EFF_FLAG:
        identifier = (can_id >> 18 & 0x7FF) << 21 | 0b11 << 19 | (can_id & 0x3FFFF) << 1
        nominal = 36
    else:
        identifier = (can_id & 0x7FF) << 2
        nominal = 17
    arbitration = identifier << 3 | 0b10 << 1 | switched
    last = np.int64(np.searchsorted(FD_LENGTHS, length))
    control = (1 if can_id & ESI_FLAG else 0) << 4 | last
    arbitration_stuff_bits, run, level = _stuff(arbitration, nominal, 0, 1)
    stuff_bits, run, level = _stuff(control, 5, run, level)
    for index in range(length):
        last = np.int64(payload[index >> 3] >> np.uint64(8 * (index & 7))) & 0xFF
        more, run, level = _stuff(last, 8, run, level)
        stuff_bits += more
    if level != last & 1:  # a stuff bit came after the very last one
        stuff_bits -= 1
    crc_bits = 4 + 17 + 6 if length <= 16 else 4 + 21 + 7
    nominal += arbitration_stuff_bits + UNSTUFFED_BITS - 1
    fast = 5 + 8 * length + stuff_bits + crc_bits + 1
    return (nominal, fast) if switched else (nominal + fast, 0)


def fd_worst_case_bits(can_id: int, length: int) -> tuple[int, int]:
    """Return the length of the longest CAN FD frame with an identifier, as `fd_bits` does.

    After a stuff bit four more of its level call for the next one, which nothing does sooner. When the first
    one in the data comes depends on the bits before.

    Parameters
    ----------
    can_id : int
        Identifier with its flags; the transmitter may be error-passive or not.
    length : int
        Number of data bytes, one of `FD_LENGTHS`.
    """
    fours = np.arange(8 * length + 4) // 4 % 2
    payloads = [
        np.packbits(level ^ fours[begin : begin + 8 * length]).tobytes()
        for level in (0, 1)
        for begin in range(4)
    ]
    lengths: tuple[int, int] = max(
        fd_bits(can_id | state, length, payload_words(int.from_bytes(payload, "little")))
        for state in (0, ESI_FLAG)
        for payload in payloads
    )
    return lengths


def payload_words(data: int) -> NDArray[np.uint64]:
    """Return a payload of up to 64 bytes, byte 0 in its low eight bits, as 8 words."""
    return np.frombuffer(bytearray(data.to_bytes(64, "little")), np.uint64)


def fd_log_data(lengths: tuple[int, int], payload: int) -> int:
    """Return the data word of a CAN FD frame in a log: what `fd_bits` says, and the row of its payload."""
    nominal, fast = lengths
    return payload << PAYLOAD_SHIFT | fast << FAST_SHIFT | nominal


def traffic_bits(traffic: NDArray[Any]) -> NDArray[np.int64]:
    """Return the length of each frame of a log, error frames with what they destroyed.

    Parameters
    ----------
    traffic : ndarray, shape (frames, 4)
        Time, id, dlc, data; see `hil.bus.wire.Wire.traffic`.

    Returns
    -------
    ndarray of int64, shape (frames, 2)
        Bits at the nominal rate and at the data rate.
    """
    lengths: NDArray[np.int64] = _logged_bits(np.ascontiguousarray(traffic, np.uint64).view(np.int64))
    return lengths


@njit("int64[:,::1](int64[:,::1])", depends=("dbc.frame",))
def _logged_bits(traffic):  # type: ignore[no-untyped-def]
    lengths = np.zeros((traffic.shape[0], 2), np.int64)
    for row in range(traffic.shape[0]):
        can_id, dlc, data = traffic[row, 1], traffic[row, 2], traffic[row, 3]
        if can_id & ERR_FLAG:
            high, low = data >> 8 * ERROR_MORE_BITS_BYTE & 0xFF, data >> 8 * ERROR_BITS_BYTE & 0xFF
            lengths[row, 0] = (high << 8 | low) + INTERMISSION_BITS
            lengths[row, 1] = data & 0xFFFF
        elif can_id & FD_FLAG:
            lengths[row, 0] = data & LENGTH_MASK
            lengths[row, 1] = data >> FAST_SHIFT & LENGTH_MASK
        else:
            lengths[row, 0] = classic_bits(can_id, dlc, np.uint64(data))
    return lengths


def frame_bits(message: can.Message) -> int:
    """Return the length of a data or remote frame in bits; of an FD frame, at both rates together.

    Raises
    ------
    ValueError
        For an error frame, whose length depends on how many nodes answer it.
    """
    if message.is_error_frame:
        raise ValueError("an error frame has no fixed length")
    flags = EFF_FLAG if message.is_extended_id else 0
    data = int.from_bytes(message.data, "little")
    if message.is_fd:
        flags |= (BRS_FLAG if message.bitrate_switch else 0) | (
            ESI_FLAG if message.error_state_indicator else 0
        )
        length = dlc2len(len2dlc(message.dlc))
        return sum(fd_bits(message.arbitration_id | flags, length, payload_words(data)))
    flags |= RTR_FLAG if message.is_remote_frame else 0
    bits: int = classic_bits(message.arbitration_id | flags, message.dlc, data)
    return bits
