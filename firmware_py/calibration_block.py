"""The calibration block as flashed, in restricted Python: which words are legal, and the check at power-on.

See `firmware_py.task_layout` for its words; `firmware_py.calibration` makes a block and says what is wrong
with one.
"""

from dbc.machine import Array32, int32
from firmware_py.kernel.fal import log2_q22
from firmware_py.kernel.fixedpoint import INT32_MAX
from firmware_py.kernel.layout import (
    CAL_COMMAND_SLEW,
    CAL_COMMAND_SMOOTH,
    CAL_ESO_A1,
    CAL_ESO_A2,
    CAL_ESO_B0,
    CAL_ESO_BETA1,
    CAL_ESO_BETA2,
    CAL_ESO_BETA3,
    CAL_ESO_BETA4,
    CAL_ESO_DELTA,
    CAL_FB_A1,
    CAL_FB_A2,
    CAL_FB_DELTA1,
    CAL_FB_DELTA2,
    CAL_FB_DELTA3,
    CAL_FB_K1,
    CAL_FB_K2,
    CAL_FB_K3,
    CAL_FB_Z4,
    CAL_FRONT_EXTEND,
    CAL_FRONT_LEAD,
    CAL_FRONT_RETRACT,
    CAL_FRONT_SMOOTH,
    CAL_LEAD_V1,
    CAL_LEAD_V2,
    CAL_LIMITER_BRAKE,
    CAL_LIMITER_RATE,
    CAL_LIMITER_SLEW,
    CAL_P_KP,
    CAL_PI_KI,
    CAL_PI_KP,
    CAL_SCHEDULED_B0,
    CAL_SCHEDULED_BETA1,
    CAL_SCHEDULED_BETA2,
    CAL_SCHEDULED_BETA3,
    CAL_SCHEDULED_BETA4,
    CAL_SCHEDULED_BETA4_SOFT,
    CAL_SCHEDULED_K1,
    CAL_SCHEDULED_K2,
    CAL_SCHEDULED_K3,
    CAL_SCHEDULED_K3_SOFT,
    CAL_SCHEDULED_MOTOR,
    CAL_SIZE,
    CAL_STIFFNESS_A,
    CAL_STIFFNESS_B,
    CAL_STIFFNESS_END_A,
    CAL_STIFFNESS_END_B,
    CAL_STROKE,
    CAL_TD_D,
    CAL_TD_H,
    CAL_TD_K,
    CAL_U_LIMIT,
    LAW_P,
    LAW_SCHEDULED,
    LAYOUT_VERSION,
)
from firmware_py.task_layout import BLOCK_COUNT, BLOCK_CRC, BLOCK_MAGIC, BLOCK_VERSION, BLOCK_WORDS

MAGIC = 0x43484444  # "DDHC"

# a gain's shift: with 8 or more, sums of a few gains' outputs stay far within 64 bits
MIN_SHIFT = 8
MAX_SHIFT = 62

# columns of LIMITS
WORD = 0
HIGHEST = 1

# indices of the gains' mantissas, legal within +-INT32_MAX; the shift follows each
GAINS = (
    CAL_P_KP,
    CAL_PI_KP,
    CAL_PI_KI,
    CAL_TD_K,
    CAL_TD_H,
    CAL_LEAD_V1,
    CAL_LEAD_V2,
    CAL_ESO_BETA1,
    CAL_ESO_BETA2,
    CAL_ESO_BETA3,
    CAL_ESO_BETA4,
    CAL_ESO_A1,
    CAL_ESO_A2,
    CAL_ESO_B0,
    CAL_FB_K1,
    CAL_FB_K2,
    CAL_FB_K3,
    CAL_FB_A1,
    CAL_FB_A2,
    CAL_FB_Z4,
    CAL_FRONT_SMOOTH,
    CAL_FRONT_LEAD,
    CAL_FRONT_EXTEND,
    CAL_FRONT_RETRACT,
    CAL_COMMAND_SMOOTH,
    CAL_SCHEDULED_BETA1,
    CAL_SCHEDULED_BETA2,
    CAL_SCHEDULED_BETA3,
    CAL_SCHEDULED_BETA4,
    CAL_SCHEDULED_BETA4_SOFT,
    CAL_SCHEDULED_B0,
    CAL_SCHEDULED_MOTOR,
    CAL_SCHEDULED_K1,
    CAL_SCHEDULED_K2,
    CAL_SCHEDULED_K3,
    CAL_SCHEDULED_K3_SOFT,
)

# indices of fal's linear zones, legal from 1 on; the logarithm follows each
ZONES = (CAL_ESO_DELTA, CAL_FB_DELTA1, CAL_FB_DELTA2, CAL_FB_DELTA3)

# of the other words: index and highest legal value, from 1 on; so no 64-bit intermediate overflows
LIMITS = (
    (CAL_U_LIMIT, INT32_MAX),
    (CAL_LIMITER_RATE, 0x1000000),
    (CAL_LIMITER_SLEW, 0x1000000),
    (CAL_LIMITER_BRAKE, 0x1000000),
    (CAL_TD_D, 0x2000000),
    (CAL_COMMAND_SLEW, INT32_MAX),
    (CAL_STROKE, INT32_MAX),
    (CAL_STIFFNESS_END_A, INT32_MAX),
    (CAL_STIFFNESS_END_B, INT32_MAX),
    (CAL_STIFFNESS_A, INT32_MAX),
    (CAL_STIFFNESS_B, INT32_MAX),
)

# of four bits: their remainder by the polynomial 0x04C11DB7, bits reversed
# fmt: off
CRC32_TABLE = (
    0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
    -0x12477CE0, -0x0FF06CBC, -0x29295C18, -0x349E4C74, -0x649B3D50, -0x792C2D2C, -0x5FF51D88, -0x42420DE4,
)
# fmt: on


def block_crc(block: Array32) -> int32:
    """CRC-32 of all that precedes the block's own: zlib's, of the words as little endian bytes."""
    crc = -1
    for place in range(BLOCK_CRC):
        crc = crc ^ block[place]
        for _nibble in range(8):
            crc = ((crc >> 4) & 0x0FFFFFFF) ^ CRC32_TABLE[crc & 15]
    return crc ^ -1


def words_are_legal(block: Array32) -> int32:
    """Whether all words of a calibration block are in their ranges, logarithms being those of the zones."""
    for row in range(len(GAINS)):
        mantissa = BLOCK_WORDS + GAINS[row]
        shift = block[mantissa + 1]
        if block[mantissa] < -INT32_MAX or shift < MIN_SHIFT or shift > MAX_SHIFT:
            return 0
    for row in range(len(ZONES)):
        zone = BLOCK_WORDS + ZONES[row]
        if block[zone] < 1 or block[zone + 1] != log2_q22(block[zone]):
            return 0
    for row in range(len(LIMITS)):
        word = block[BLOCK_WORDS + LIMITS[row][WORD]]
        if word < 1 or word > LIMITS[row][HIGHEST]:
            return 0
    return 1


def law_of_block(block: Array32) -> int32:
    """Default control law of a calibration block, 0 if the block is not valid."""
    law = (block[BLOCK_VERSION] >> 16) & 0xFFFF
    if block[BLOCK_MAGIC] != MAGIC or (block[BLOCK_VERSION] & 0xFFFF) != LAYOUT_VERSION:
        return 0
    if (block[BLOCK_COUNT] & 0xFFFF) != CAL_SIZE or block[BLOCK_CRC] != block_crc(block):
        return 0
    if law < LAW_P or law > LAW_SCHEDULED or words_are_legal(block) == 0:
        return 0
    return law
