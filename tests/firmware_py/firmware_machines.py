"""The whole firmware on each of its machines: events in, what each period sends and leaves behind out."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from c_builds import output_of
from firmware_events import CONTRACT, FRAME, POWER_ON, Event

from dbc.contract import Contract
from firmware_py import checked, entry_points
from firmware_py import task_layout as at
from firmware_py.calibration import Calibration
from firmware_py.contract_words import contract_words
from firmware_py.emulated.image import reference_image
from firmware_py.emulated.machine import Machine
from firmware_py.emulated.node import CAN, TO_SEND
from firmware_py.kernel import layout as k

WORDS = at.MAILBOXES_SIZE + at.TASK_SIZE + k.ST_SIZE + k.IO_SIZE
"""Words a firmware keeps; they follow the frames in a row."""

ROW = 1 + 3 * at.MAX_FRAMES + WORDS


def in_c(program: Path, events: Iterable[Event]) -> np.ndarray:
    """Rows of the exported C."""
    words = [(event.kind, *event.frame) for event in events]
    packed = np.array([[word - (word >> 63 << 64) for word in row] for row in words], np.int64)
    return np.frombuffer(output_of(program, packed), np.int64).reshape(-1, ROW)


def compiled_by_numba(
    calibration: Calibration, events: Iterable[Event], contract: Contract = CONTRACT
) -> np.ndarray:
    """Rows of what the bench runs."""
    memory = entry_points.new_memory(contract_words(contract))
    entry_points.flash_calibration(memory, calibration.to_bytes())
    sends, record = (
        np.zeros((at.MAX_FRAMES, 3), np.uint64),
        np.zeros(len(entry_points.RECORD_COLUMNS), np.int64),
    )
    kept = [*range(at.CONTRACT_SIZE, at.CONTRACT_SIZE + at.MAILBOXES_SIZE + at.TASK_SIZE)]
    kernel = kept[-1] + 1 + at.BLOCK_SIZE
    kept += range(kernel, kernel + k.ST_SIZE + k.IO_SIZE)
    rows = []
    for kind, frame in events:
        if kind == POWER_ON:
            entry_points.power_on(memory)
        elif kind == FRAME:
            entry_points.receive(memory, *frame)
        else:
            count = entry_points.period(memory, sends, record, 0)
            sends[count:] = 0
            rows.append([count, *sends.view(np.int64).ravel().tolist(), *memory[kept].tolist()])
    return np.array(rows, np.int64)


def emulated(processor: str, calibration: Calibration, events: Iterable[Event]) -> np.ndarray:
    """Rows of the committed image of a processor."""
    machine = Machine(processor, reference_image(processor))
    symbols = machine.image.symbols
    machine.write(symbols["ddh_calibration"], calibration.to_bytes())
    rows = []
    for kind, frame in events:
        if kind == POWER_ON:
            machine.start()
        elif kind == FRAME:
            machine.write_words(CAN, (frame.can_id, frame.dlc, frame.data, frame.data >> 32))
            machine.call("can_receive_handler")
        else:
            machine.call("timer_handler")
            count, *words = machine.read_words(TO_SEND, 1 + at.FRAMES_SIZE)
            rows.append(
                [
                    count,
                    *_sent(words[: count * at.FRAME_SIZE]),
                    *machine.read_words(symbols["controller"], WORDS),
                ]
            )
    return np.array(rows, np.int64)


def _sent(words: Sequence[int]) -> list[int]:
    """Identifier, length and data of each frame, and zeros up to the most that can be sent."""
    sent = []
    for first in range(0, len(words), at.FRAME_SIZE):
        can_id, length, low, high = words[first : first + at.FRAME_SIZE]
        sent += [can_id & 0xFFFFFFFF, length, int(high) << 32 | int(low) & 0xFFFFFFFF]
    return sent + (3 * at.MAX_FRAMES - len(sent)) * [0]


def interpreted(
    modules: dict[str, ModuleType], calibration: Calibration, events: Iterable[Event]
) -> np.ndarray:
    """Rows of the source on checked integers."""
    task = modules["task"]
    block = np.frombuffer(calibration.to_bytes(), "<i4")
    contract, block, flashed = (
        checked.CheckedArray(words) for words in (contract_words(CONTRACT), block, calibration.words)
    )
    mailboxes, words, state, io, frames = (
        checked.CheckedArray([0] * size)
        for size in (at.MAILBOXES_SIZE, at.TASK_SIZE, k.ST_SIZE, k.IO_SIZE, at.FRAMES_SIZE)
    )
    rows = []
    for kind, frame in events:
        if kind == POWER_ON:
            task.power_on(contract, mailboxes, words, block, state, io)
        elif kind == FRAME:
            data = [checked.low32(frame.data), checked.low32(frame.data >> 32)]
            numbers = checked.low32(frame.can_id), checked.i32(frame.dlc), *data
            task.receive(contract, mailboxes, words, *numbers)
        else:
            count = task.period(contract, mailboxes, words, flashed, state, io, frames)
            sent = _sent(frames[: count * at.FRAME_SIZE])
            rows.append([count, *sent, *mailboxes, *words, *state, *io])
    return np.array([[int(word) for word in row] for row in rows], np.int64)
