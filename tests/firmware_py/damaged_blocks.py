"""Calibration blocks that have to be refused, and what the host says of each."""

import struct
import zlib

from firmware_py.kernel import layout as k
from firmware_py.tuning import Tuning

BLOCK = Tuning().calibration().to_bytes()
"""A good one."""

HEADER_BYTES = 12


def resealed(block: bytes) -> bytes:
    """`block` with a fitting CRC."""
    return block[:-4] + struct.pack("<I", zlib.crc32(block[:-4]))


def with_words(words: dict[int, int]) -> bytes:
    """A block with other words at some indices and a fitting CRC."""
    block = bytearray(BLOCK)
    for index, word in words.items():
        struct.pack_into("<i", block, HEADER_BYTES + 4 * index, word)
    return resealed(bytes(block))


DAMAGED = [
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
]

ILLEGAL_WORDS = [
    (k.CAL_TD_D, 0, "CAL_TD_D = 0 outside 1..33554432"),
    (k.CAL_FB_K1 + 1, 7, "CAL_FB_K1 shift = 7 outside 8..62"),
    (k.CAL_FB_K1 + 1, 63, "CAL_FB_K1 shift = 63 outside 8..62"),
    (k.CAL_FB_K1, -(2**31), "CAL_FB_K1 = -2147483648 outside -2147483647..2147483647"),
    (k.CAL_ESO_DELTA, 0, "CAL_ESO_DELTA = 0 outside 1..2147483647"),
    (k.CAL_ESO_DELTA, 2**17, r"CAL_ESO_DELTA log2 = \d+ outside 71303168..71303168"),
    (k.CAL_FB_DELTA3 + 1, 0, r"CAL_FB_DELTA3 log2 = 0 outside \d+"),
    (k.CAL_LIMITER_BRAKE, 2**24 + 1, "CAL_LIMITER_BRAKE = 16777217 outside 1..16777216"),
]
