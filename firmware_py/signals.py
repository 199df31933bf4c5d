"""Signals in a payload of two 32-bit words, byte 0 in the low eight bits of the first."""

from dbc.machine import Array32, i32, i64, int32, low32
from firmware_py.task_layout import (
    FRAME_HIGH,
    FRAME_ID,
    FRAME_LENGTH,
    FRAME_LOW,
    MESSAGE_ID,
    MESSAGE_LENGTH,
)


def extract(low: int32, high: int32, start: int32, length: int32, is_signed: int32) -> int32:
    """Value of the signal of `length` bits from bit `start` on; 1 to 31 bits, 32 if signed."""
    payload = (i64(high) << 32) | (i64(low) & 0xFFFFFFFF)
    value = (payload >> start) & ((i64(1) << length) - 1)
    if is_signed != 0:
        sign = i64(1) << (length - 1)
        value = (value ^ sign) - sign
    return i32(value)


def begin(frames: Array32, frame: int32, contract: Array32, message: int32) -> None:
    """Make `frame` one of `message`, all signals 0."""
    frames[frame + FRAME_ID] = contract[message + MESSAGE_ID]
    frames[frame + FRAME_LENGTH] = contract[message + MESSAGE_LENGTH]
    frames[frame + FRAME_LOW] = 0
    frames[frame + FRAME_HIGH] = 0


def insert(frames: Array32, frame: int32, contract: Array32, signal: int32, value: int32) -> None:
    """Set a signal that is still 0 to the low bits of `value`."""
    start = contract[signal]
    bits = i64(value) & ((i64(1) << contract[signal + 1]) - 1)
    if start < 32:
        bits = bits << start
        frames[frame + FRAME_LOW] = frames[frame + FRAME_LOW] | low32(bits)
        bits = bits >> 32
    else:
        bits = bits << (start - 32)
    frames[frame + FRAME_HIGH] = frames[frame + FRAME_HIGH] | low32(bits)
