"""The calibration block as flashed: a versioned header, the kernel's int32 words, a CRC-32.

Layout, little endian: magic "DDHC", uint16 layout version, uint16 default control law, uint16 number of
words, uint16 zero, the words, uint32 CRC-32 (zlib's) of all that precedes it.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22

MAGIC = b"DDHC"
_HEADER = struct.Struct("<4sHHHH")
_CRC = struct.Struct("<I")

INT32_MAX = 2**31 - 1
MIN_SHIFT, MAX_SHIFT = 8, 62
"""A gain's shift: with 8 or more, sums of a few gains' outputs stay far within 64 bits."""

GAINS = (
    k.CAL_P_KP,
    k.CAL_PI_KP,
    k.CAL_PI_KI,
    k.CAL_TD_K,
    k.CAL_TD_H,
    k.CAL_LEAD_V1,
    k.CAL_LEAD_V2,
    k.CAL_ESO_BETA1,
    k.CAL_ESO_BETA2,
    k.CAL_ESO_BETA3,
    k.CAL_ESO_BETA4,
    k.CAL_ESO_A1,
    k.CAL_ESO_A2,
    k.CAL_ESO_B0,
    k.CAL_FB_K1,
    k.CAL_FB_K2,
    k.CAL_FB_K3,
    k.CAL_FB_A1,
    k.CAL_FB_A2,
    k.CAL_FB_Z4,
    k.CAL_FRONT_SMOOTH,
    k.CAL_FRONT_LEAD,
    k.CAL_FRONT_EXTEND,
    k.CAL_FRONT_RETRACT,
    k.CAL_COMMAND_SMOOTH,
    k.CAL_SCHEDULED_BETA1,
    k.CAL_SCHEDULED_BETA2,
    k.CAL_SCHEDULED_BETA3,
    k.CAL_SCHEDULED_BETA4,
    k.CAL_SCHEDULED_BETA4_SOFT,
    k.CAL_SCHEDULED_B0,
    k.CAL_SCHEDULED_MOTOR,
    k.CAL_SCHEDULED_K1,
    k.CAL_SCHEDULED_K2,
    k.CAL_SCHEDULED_K3,
    k.CAL_SCHEDULED_K3_SOFT,
)
"""Indices of the mantissas; the shift follows each."""

ZONES = (k.CAL_ESO_DELTA, k.CAL_FB_DELTA1, k.CAL_FB_DELTA2, k.CAL_FB_DELTA3)
"""Indices of fal's linear zones; the logarithm follows each."""

VALUE_RANGES = {
    k.CAL_U_LIMIT: (1, INT32_MAX),
    k.CAL_LIMITER_RATE: (1, 2**24),
    k.CAL_LIMITER_SLEW: (1, 2**24),
    k.CAL_LIMITER_BRAKE: (1, 2**24),
    k.CAL_TD_D: (1, 2**25),
    k.CAL_COMMAND_SLEW: (1, INT32_MAX),
    k.CAL_STROKE: (1, INT32_MAX),
    k.CAL_STIFFNESS_END_A: (1, INT32_MAX),
    k.CAL_STIFFNESS_END_B: (1, INT32_MAX),
    k.CAL_STIFFNESS_A: (1, INT32_MAX),
    k.CAL_STIFFNESS_B: (1, INT32_MAX),
} | dict.fromkeys(ZONES, (1, INT32_MAX))
"""Legal values of the other words, logarithms left out; within them no 64-bit intermediate overflows."""

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
        expected = _HEADER.size + 4 * k.CAL_SIZE + _CRC.size
        if count != k.CAL_SIZE or len(block) != expected:
            raise CalibrationError(
                f"calibration: {count} words in {len(block)} bytes instead of {k.CAL_SIZE} in {expected}"
            )
        body = block[: -_CRC.size]
        (crc,) = _CRC.unpack(block[-_CRC.size :])
        if crc != zlib.crc32(body):
            raise CalibrationError(f"calibration: CRC {crc:#010x} instead of {zlib.crc32(body):#010x}")
        return cls(law, struct.unpack_from(f"<{k.CAL_SIZE}i", block, _HEADER.size))
