"""Exact length of frames on the wire, in bits, stuff bits included (ISO 11898-1).

Lengths run from the start of frame to the end of the three bits of intermission.
"""

from typing import Any

import can
import numpy as np
from can.util import dlc2len, len2dlc
from numpy.typing import NDArray

from dbc.frame import EFF_FLAG, ERR_FLAG
from dbc.jit import njit

RTR_FLAG = 0x4000_0000
"""Set in an identifier word for a remote frame, as in SocketCAN's `can_id`."""

INTERMISSION_BITS = 3
ERROR_BITS_BYTE = 5
"""Byte of an error frame's data in a log: bits from the start of what it destroyed to its own end."""

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


def traffic_bits(traffic: NDArray[Any]) -> NDArray[np.int64]:
    """Return the length in bits of each frame of a log, error frames with what they destroyed.

    Its rows are time, id, dlc, data.
    """
    return np.array([_logged_bits(*frame) for _, *frame in traffic.tolist()], np.int64)


def _logged_bits(can_id: int, dlc: int, data: int) -> int:
    if can_id & ERR_FLAG:
        return (data >> 8 * ERROR_BITS_BYTE & 0xFF) + INTERMISSION_BITS
    bits: int = classic_bits(can_id, dlc, data)
    return bits


def fd_bits(message: can.Message) -> tuple[int, int]:
    """Return the length of an ISO CAN FD frame as (bits at the nominal rate, bits at the data rate).

    Without a bit rate switch all bits are at the nominal rate. Dynamic stuffing ends with the data field:
    after five equal bits at its very end the fixed stuff bit of the CRC field takes the dynamic one's place.
    """
    dlc = len2dlc(message.dlc)
    length = dlc2len(dlc)
    data = int.from_bytes(bytes(message.data).ljust(length, b"\0"), "big")
    if message.is_extended_id:
        identifier = f"{message.arbitration_id >> 18:011b}11{message.arbitration_id & 0x3FFFF:018b}0"
    else:
        identifier = f"{message.arbitration_id:011b}00"
    arbitration = f"0{identifier}10{message.bitrate_switch:b}"
    control = f"{message.error_state_indicator:b}{dlc:04b}"
    payload = f"{data:0{8 * length}b}" if length else ""
    crc_field = 4 + 17 + 6 if length <= 16 else 4 + 21 + 7

    nominal_stuff_bits = _stuff_bits(arbitration)
    stuff_bits = _stuff_bits((arbitration + control + payload)[:-1])
    nominal = len(arbitration) + nominal_stuff_bits + UNSTUFFED_BITS - 1
    fast = len(control) + len(payload) + stuff_bits - nominal_stuff_bits + crc_field + 1
    return (nominal, fast) if message.bitrate_switch else (nominal + fast, 0)


def frame_bits(message: can.Message) -> int:
    """Return the length of a data or remote frame in bits; of an FD frame, at both rates together.

    Raises
    ------
    ValueError
        For an error frame, whose length depends on how many nodes answer it.
    """
    if message.is_error_frame:
        raise ValueError("an error frame has no fixed length")
    if message.is_fd:
        return sum(fd_bits(message))
    flags = (EFF_FLAG if message.is_extended_id else 0) | (RTR_FLAG if message.is_remote_frame else 0)
    data = int.from_bytes(message.data, "little")
    bits: int = classic_bits(message.arbitration_id | flags, message.dlc, data)
    return bits


def _stuff_bits(bits: str) -> int:
    """Return the number of stuff bits that a sequence of '0' and '1' gets."""
    stuff_bits = run = 0
    level = ""
    for bit in bits:
        run = run + 1 if bit == level else 1
        level = bit
        if run == 5:
            stuff_bits += 1
            run = 1
            level = "1" if bit == "0" else "0"
    return stuff_bits
