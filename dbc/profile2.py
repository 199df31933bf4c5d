"""AUTOSAR end-to-end protection, profile 2, in restricted Python: CRC-8, protect, check.

The receiver's state and configuration lie in flat arrays, from a given index on. A payload is two 32-bit
words, byte 0 in the low eight bits of `low`. See `dbc.e2e` for the specification it follows.
"""

from dbc.machine import Array32, i32, int32

MAX_COUNTER = 15

# what a check comes to, with the values of E2E_P02CheckStatusType
OK = 0x00
NONEWDATA = 0x01
WRONGCRC = 0x02
SYNC = 0x03
INITIAL = 0x04
REPEATED = 0x08
OKSOMELOST = 0x20
WRONGSEQUENCE = 0x40

# a receiver's configuration: 16 DataIDs, then
DLC = 16  # payload length in bytes
MAX_DELTA_COUNTER_INIT = 17
MAX_NO_NEW_OR_REPEATED_DATA = 18
SYNC_COUNTER_INIT = 19
CONFIGURATION_SIZE = 20

# a receiver's state
NOT_FIRST = 0  # whether there has been valid data
LAST_VALID_COUNTER = 1
MAX_DELTA_COUNTER = 2
SYNC_COUNTER = 3
NO_NEW_OR_REPEATED_DATA_COUNTER = 4
LOST_DATA = 5
STATE_SIZE = 6

# fmt: off
# of a byte: its remainder by the polynomial 0x2F
CRC_TABLE = (
    0x00, 0x2F, 0x5E, 0x71, 0xBC, 0x93, 0xE2, 0xCD, 0x57, 0x78, 0x09, 0x26, 0xEB, 0xC4, 0xB5, 0x9A,
    0xAE, 0x81, 0xF0, 0xDF, 0x12, 0x3D, 0x4C, 0x63, 0xF9, 0xD6, 0xA7, 0x88, 0x45, 0x6A, 0x1B, 0x34,
    0x73, 0x5C, 0x2D, 0x02, 0xCF, 0xE0, 0x91, 0xBE, 0x24, 0x0B, 0x7A, 0x55, 0x98, 0xB7, 0xC6, 0xE9,
    0xDD, 0xF2, 0x83, 0xAC, 0x61, 0x4E, 0x3F, 0x10, 0x8A, 0xA5, 0xD4, 0xFB, 0x36, 0x19, 0x68, 0x47,
    0xE6, 0xC9, 0xB8, 0x97, 0x5A, 0x75, 0x04, 0x2B, 0xB1, 0x9E, 0xEF, 0xC0, 0x0D, 0x22, 0x53, 0x7C,
    0x48, 0x67, 0x16, 0x39, 0xF4, 0xDB, 0xAA, 0x85, 0x1F, 0x30, 0x41, 0x6E, 0xA3, 0x8C, 0xFD, 0xD2,
    0x95, 0xBA, 0xCB, 0xE4, 0x29, 0x06, 0x77, 0x58, 0xC2, 0xED, 0x9C, 0xB3, 0x7E, 0x51, 0x20, 0x0F,
    0x3B, 0x14, 0x65, 0x4A, 0x87, 0xA8, 0xD9, 0xF6, 0x6C, 0x43, 0x32, 0x1D, 0xD0, 0xFF, 0x8E, 0xA1,
    0xE3, 0xCC, 0xBD, 0x92, 0x5F, 0x70, 0x01, 0x2E, 0xB4, 0x9B, 0xEA, 0xC5, 0x08, 0x27, 0x56, 0x79,
    0x4D, 0x62, 0x13, 0x3C, 0xF1, 0xDE, 0xAF, 0x80, 0x1A, 0x35, 0x44, 0x6B, 0xA6, 0x89, 0xF8, 0xD7,
    0x90, 0xBF, 0xCE, 0xE1, 0x2C, 0x03, 0x72, 0x5D, 0xC7, 0xE8, 0x99, 0xB6, 0x7B, 0x54, 0x25, 0x0A,
    0x3E, 0x11, 0x60, 0x4F, 0x82, 0xAD, 0xDC, 0xF3, 0x69, 0x46, 0x37, 0x18, 0xD5, 0xFA, 0x8B, 0xA4,
    0x05, 0x2A, 0x5B, 0x74, 0xB9, 0x96, 0xE7, 0xC8, 0x52, 0x7D, 0x0C, 0x23, 0xEE, 0xC1, 0xB0, 0x9F,
    0xAB, 0x84, 0xF5, 0xDA, 0x17, 0x38, 0x49, 0x66, 0xFC, 0xD3, 0xA2, 0x8D, 0x40, 0x6F, 0x1E, 0x31,
    0x76, 0x59, 0x28, 0x07, 0xCA, 0xE5, 0x94, 0xBB, 0x21, 0x0E, 0x7F, 0x50, 0x9D, 0xB2, 0xC3, 0xEC,
    0xD8, 0xF7, 0x86, 0xA9, 0x64, 0x4B, 0x3A, 0x15, 0x8F, 0xA0, 0xD1, 0xFE, 0x33, 0x1C, 0x6D, 0x42,
)
# fmt: on


def profile2_crc(low: int32, high: int32, length: int32, data_id: int32) -> int32:
    """CRC of a payload of `length` bytes, 2..8, and the DataID of its counter (SWS_E2E_00133).

    CRC-8 with polynomial 0x2F, initial value and final XOR 0xFF, over bytes 1 to `length` - 1 and the DataID.
    """
    crc = 0xFF
    word = low >> 8
    position = 1
    while position < length:
        if position == 4:
            word = high
        crc = CRC_TABLE[(crc ^ word) & 0xFF]
        word = word >> 8
        position = position + 1
    return CRC_TABLE[(crc ^ data_id) & 0xFF] ^ 0xFF


def profile2_protect(
    configuration: Array32, configured: int32, counter: int32, low: int32, high: int32
) -> int32:
    """E2E_P02Protect: the payload's low word with the counter, 0..15, and the CRC filled in."""
    word = (low & -0x1000) | (counter << 8)
    return word | profile2_crc(
        word, high, configuration[configured + DLC], configuration[configured + counter]
    )


def profile2_is_accepted(status: int32) -> int32:
    """Whether the data may be used (E2E_P02MapStatusToSM with the R4.2 profile behaviour)."""
    if status == OK or status == OKSOMELOST or status == SYNC:  # noqa: SIM109
        return 1
    return 0


def profile2_check(
    state: Array32,
    received: int32,
    configuration: Array32,
    configured: int32,
    low: int32,
    high: int32,
    has_arrived: int32,
) -> int32:
    """E2E_P02Check: the status of one received payload.

    Parameters
    ----------
    state : array, STATE_SIZE words from `received` on
        The receiver's state, updated in place; all zero at power-on.
    configuration : array, CONFIGURATION_SIZE words from `configured` on
        See `dbc.e2e.receiver_configuration`.
    low, high : int32
        The payload.
    has_arrived : int32
        0 if nothing arrived since the last call; the payload is not looked at then.
    """
    if state[received + MAX_DELTA_COUNTER] < MAX_COUNTER:
        state[received + MAX_DELTA_COUNTER] = i32(state[received + MAX_DELTA_COUNTER] + 1)
    silence = state[received + NO_NEW_OR_REPEATED_DATA_COUNTER]
    longer_silence = silence
    if silence < MAX_COUNTER:
        longer_silence = i32(silence + 1)
    if has_arrived == 0:
        state[received + NO_NEW_OR_REPEATED_DATA_COUNTER] = longer_silence
        return NONEWDATA
    counter = (low >> 8) & MAX_COUNTER
    crc = profile2_crc(low, high, configuration[configured + DLC], configuration[configured + counter])
    if crc != (low & 0xFF):
        return WRONGCRC
    delta = (counter - state[received + LAST_VALID_COUNTER]) & MAX_COUNTER
    status = OK
    if state[received + NOT_FIRST] == 0:
        state[received + NOT_FIRST] = 1
        status = INITIAL
    elif delta == 0:
        state[received + NO_NEW_OR_REPEATED_DATA_COUNTER] = longer_silence
        return REPEATED
    elif delta > state[received + MAX_DELTA_COUNTER]:  # SWS_E2E_00145: the counter jumped too far
        state[received + NO_NEW_OR_REPEATED_DATA_COUNTER] = 0
        state[received + SYNC_COUNTER] = configuration[configured + SYNC_COUNTER_INIT]
        if configuration[configured + SYNC_COUNTER_INIT] == 0:
            return WRONGSEQUENCE
        status = WRONGSEQUENCE
    else:  # SWS_E2E_00298, 00299: good once enough counters in a row were valid
        state[received + NO_NEW_OR_REPEATED_DATA_COUNTER] = 0
        state[received + LOST_DATA] = i32(delta - 1)
        if silence > configuration[configured + MAX_NO_NEW_OR_REPEATED_DATA]:
            state[received + SYNC_COUNTER] = configuration[configured + SYNC_COUNTER_INIT]
            status = SYNC
        elif state[received + SYNC_COUNTER] > 0:
            state[received + SYNC_COUNTER] = i32(state[received + SYNC_COUNTER] - 1)
            status = SYNC
        elif delta > 1:
            status = OKSOMELOST
    state[received + MAX_DELTA_COUNTER] = configuration[configured + MAX_DELTA_COUNTER_INIT]
    state[received + LAST_VALID_COUNTER] = counter
    return status
