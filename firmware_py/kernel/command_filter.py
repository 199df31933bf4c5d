"""Command filter: slew limit and low-pass on the way to the drive, against chatter."""

from dbc.machine import Array32, i32, i64, int32
from firmware_py.kernel.fixedpoint import clamp, gain, sat32
from firmware_py.kernel.layout import CAL_COMMAND_SLEW, CAL_COMMAND_SMOOTH, CAL_U_LIMIT, ST_COMMAND


def command_filter_reset(state: Array32) -> None:
    """Start at standstill."""
    state[ST_COMMAND] = 0


def command_filter_step(calibration: Array32, state: Array32, wanted: int32) -> int32:
    """Speed to send (2^-20 rad/s) for the `wanted` one; beyond the drive's limit it does not wind up."""
    last = i64(state[ST_COMMAND])
    change = gain(calibration, CAL_COMMAND_SMOOTH, sat32(i64(wanted) - last))
    command = last + clamp(change, i64(calibration[CAL_COMMAND_SLEW]))
    state[ST_COMMAND] = i32(clamp(command, i64(calibration[CAL_U_LIMIT])))
    return sat32(command)
