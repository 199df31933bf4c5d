"""The firmware's entry points as machine code: power-on, receive and timer interrupt."""

import numpy as np
from numba.extending import register_jitable

from dbc.jit import entry_point, njit
from dbc.machine import low32
from dbc.restricted import high_half, low_half
from firmware_py import task
from firmware_py import task_layout as at
from firmware_py.compiled import SOURCES
from firmware_py.kernel import layout as k

RECORD_COLUMNS = (
    "time_ns",
    "state",
    "faults",
    "setpoint_0p1um",
    "position_um",
    "target_velocity_0p25rpm",
    "flags",
    "v1",
    "v2",
    "v3",
    "z1",
    "z2",
    "z3",
    "z4",
)
_RECORD_KERNEL_STATE = RECORD_COLUMNS.index("v1")

# the arrays of `firmware_py.task` in one block of memory
_CONTRACT = slice(0, at.CONTRACT_SIZE)
_MAILBOXES = slice(_CONTRACT.stop, _CONTRACT.stop + at.MAILBOXES_SIZE)
_TASK = slice(_MAILBOXES.stop, _MAILBOXES.stop + at.TASK_SIZE)
_BLOCK = slice(_TASK.stop, _TASK.stop + at.BLOCK_SIZE)
_CALIBRATION = slice(_BLOCK.start + at.BLOCK_WORDS, _BLOCK.start + at.BLOCK_CRC)
_STATE = slice(_BLOCK.stop, _BLOCK.stop + k.ST_SIZE)
_IO = slice(_STATE.stop, _STATE.stop + k.IO_SIZE)
FRAMES_SENT = slice(_IO.stop, _IO.stop + at.FRAMES_SIZE)


def new_memory(contract: np.ndarray) -> np.ndarray:
    """Return what the entry points work on, for a contract (see `firmware_py.contract_words`)."""
    memory = np.zeros(FRAMES_SENT.stop, np.int32)
    memory[_CONTRACT] = contract
    return memory


def flash_calibration(memory: np.ndarray, block: bytes) -> None:
    """Put a calibration block into memory, `BLOCK_BYTES` of `firmware_py.calibration`."""
    memory[_BLOCK] = np.frombuffer(block, "<i4")


def set_execution_time(memory: np.ndarray, share_0p5percent: int) -> None:
    """Tell the firmware, once it has started, how long a control period takes."""
    memory[_TASK][at.EXECUTION_TIME] = share_0p5percent


@register_jitable
def take_frame(memory, can_id, length, data):  # type: ignore[no-untyped-def]
    """Receive interrupt; `data` is a uint64."""
    contract, mailboxes, words = memory[_CONTRACT], memory[_MAILBOXES], memory[_TASK]
    low, high = low32(low_half(data)), low32(high_half(data))
    task.receive(contract, mailboxes, words, low32(can_id), length, low, high)


@register_jitable
def run_period(memory):  # type: ignore[no-untyped-def]
    """Timer interrupt; return how many of the frames at `FRAMES_SENT` are to be sent."""
    words, state, io, frames = memory[_TASK], memory[_STATE], memory[_IO], memory[FRAMES_SENT]
    contract, mailboxes, calibration = memory[_CONTRACT], memory[_MAILBOXES], memory[_CALIBRATION]
    return task.period(contract, mailboxes, words, calibration, state, io, frames)


@register_jitable
def _unsigned(word):  # type: ignore[no-untyped-def]
    return np.uint64(np.int64(word) & 0xFFFF_FFFF)


@register_jitable
def data_of(frames, frame):  # type: ignore[no-untyped-def]
    """Payload of the frame at an index, as uint64."""
    high = _unsigned(frames[frame + at.FRAME_HIGH])
    return high << np.uint64(32) | _unsigned(frames[frame + at.FRAME_LOW])


@register_jitable
def record_period(memory, row, now_ns):  # type: ignore[no-untyped-def]
    """Fill a row of the record."""
    fill_row(row, now_ns, memory[_TASK], memory[_STATE], memory[_IO])


@register_jitable
def fill_row(row, now_ns, words, state, io):  # type: ignore[no-untyped-def]
    """Fill a row of the record from the arrays `task`, `state` and `io`."""
    row[0] = now_ns
    row[1] = words[at.STATE]
    row[2] = words[at.FAULTS]
    row[3] = io[k.IO_SETPOINT]
    row[4] = io[k.IO_POSITION]
    row[5] = words[at.VELOCITY]
    row[6] = io[k.IO_FLAGS]
    row[_RECORD_KERNEL_STATE:] = state[k.ST_V1 : k.ST_Z4 + 1]


@njit("void(int32[::1])", depends=SOURCES)
def _power_on(memory):  # type: ignore[no-untyped-def]
    contract, mailboxes, words = memory[_CONTRACT], memory[_MAILBOXES], memory[_TASK]
    task.power_on(contract, mailboxes, words, memory[_BLOCK], memory[_STATE], memory[_IO])


@njit("void(int32[::1], int64, int64, uint64)", depends=SOURCES)
def _receive(memory, can_id, length, data):  # type: ignore[no-untyped-def]
    take_frame(memory, can_id, length, data)


@njit("int64(int32[::1], uint64[:,::1], int64[::1], int64)", depends=SOURCES)
def _period(memory, sends, row, now_ns):  # type: ignore[no-untyped-def]
    count = run_period(memory)
    record_period(memory, row, now_ns)
    frames = memory[FRAMES_SENT]
    for number in range(count):
        frame = number * at.FRAME_SIZE
        sends[number, 0] = _unsigned(frames[frame + at.FRAME_ID])
        sends[number, 1] = frames[frame + at.FRAME_LENGTH]
        sends[number, 2] = data_of(frames, frame)
    return count


power_on, receive, period = entry_point(_power_on), entry_point(_receive), entry_point(_period)
