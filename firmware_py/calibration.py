"""The calibration block as flashed: a versioned header, the kernel's int32 words, a CRC-32.

Layout, little endian: magic "DDHC", uint16 layout version, uint16 default control law, uint16 number of
words, uint16 zero, the words, uint32 CRC-32 (zlib's) of all that precedes it. At power-on the firmware checks
it once more (`firmware_py.calibration_block`).
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from firmware_py import calibration_block
from firmware_py import task_layout as at
from firmware_py.calibration_block import GAINS, LIMITS, MAX_SHIFT, MIN_SHIFT, ZONES
from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22
from firmware_py.kernel.fixedpoint import INT32_MAX

MAGIC = calibration_block.MAGIC.to_bytes(4, "little")
_HEADER = struct.Struct("<4sHHHH")
_CRC = struct.Struct("<I")

BLOCK_BYTES = 4 * at.BLOCK_SIZE

VALUE_RANGES = dict.fromkeys(ZONES, (1, INT32_MAX)) | {index: (1, highest) for index, highest in LIMITS}
"""Legal values of the words that are neither gains nor logarithms, by their indices."""

WORD_NAMES = {
    value: name for name, value in vars(k).items() if name.startswith("CAL_") and name != "CAL_SIZE"
}


class CalibrationError(ValueError):
    """A calibration block the firmware must refuse: damaged, of another layout, or with an illegal word."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Words for every control law.

    Parameters
    ----------
    law : int
        Default control law, `LAW_*` of `firmware_py.kernel.layout`.
    words : tuple of int
        The kernel's `calibration` array, `CAL_SIZE` words.

    Raises
    ------
    CalibrationError
        When a word is outside its legal range.
    """

    law: int
    words: tuple[int, ...]

    def __post_init__(self) -> None:
        if not k.LAW_P <= self.law <= k.LAW_SCHEDULED:
            raise CalibrationError(f"calibration: unknown control law {self.law}")
        if len(self.words) != k.CAL_SIZE:
            raise CalibrationError(f"calibration: {len(self.words)} words instead of {k.CAL_SIZE}")
        ranges = dict(VALUE_RANGES)
        for index in GAINS:
            ranges[index] = (-INT32_MAX, INT32_MAX)
            ranges[index + 1] = (MIN_SHIFT, MAX_SHIFT)
        for index in ZONES:
            logarithm = log2_q22(max(1, self.words[index]))
            ranges[index + 1] = (logarithm, logarithm)
        for index, word in enumerate(self.words):
            low, high = ranges[index]
            if not low <= word <= high:
                second = " log2" if index - 1 in ZONES else " shift"
                name = WORD_NAMES.get(index) or WORD_NAMES[index - 1] + second
                raise CalibrationError(f"calibration: {name} = {word} outside {low}..{high}")

    def array(self) -> np.ndarray:
        """Return the words as the int32 array the kernel takes."""
        return np.array(self.words, np.int32)

    def to_bytes(self) -> bytes:
        """Return the block as flashed."""
        head = _HEADER.pack(MAGIC, k.LAYOUT_VERSION, self.law, k.CAL_SIZE, 0)
        block = head + struct.pack(f"<{k.CAL_SIZE}i", *self.words)
        return block + _CRC.pack(zlib.crc32(block))

    @classmethod
    def from_bytes(cls, block: bytes) -> "Calibration":
        """Read a block.

        Raises
        ------
        CalibrationError
            Wrong magic, layout version, length or CRC, or an illegal word; the message is one line.
        """
        if block[:4] != MAGIC:
            raise CalibrationError(f"calibration: magic {block[:4]!r} instead of {MAGIC!r}")
        if len(block) < _HEADER.size:
            raise CalibrationError(f"calibration: {len(block)} bytes are too short for the header")
        _, version, law, count, _ = _HEADER.unpack_from(block)
        if version != k.LAYOUT_VERSION:
            raise CalibrationError(f"calibration: layout version {version} instead of {k.LAYOUT_VERSION}")
        if count != k.CAL_SIZE or len(block) != BLOCK_BYTES:
            raise CalibrationError(
                f"calibration: {count} words in {len(block)} bytes instead of {k.CAL_SIZE} in {BLOCK_BYTES}"
            )
        body = block[: -_CRC.size]
        (crc,) = _CRC.unpack(block[-_CRC.size :])
        if crc != zlib.crc32(body):
            raise CalibrationError(f"calibration: CRC {crc:#010x} instead of {zlib.crc32(body):#010x}")
        return cls(law, struct.unpack_from(f"<{k.CAL_SIZE}i", block, _HEADER.size))


def flashed(block: bytes) -> bytes:
    """Return what `BLOCK_BYTES` of flash hold once a block is written; erased, if that has another size."""
    return block if len(block) == BLOCK_BYTES else b"\xff" * BLOCK_BYTES
