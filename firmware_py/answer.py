"""The controller's interrupts in one compiled call, for the events that make up nearly all of a run."""

import numpy as np
from numba.extending import register_jitable

from dbc.jit import entry_point, njit
from dbc.node import next_period
from dbc.packet import FRAME_WORDS, FRAMES, HEAD_DLC, ID_MASK, KIND, NOT_ANSWERED, TIME, TIMER, put_frame
from firmware_py.entry_points import FRAMES_SENT, SOURCES, data_of, record_period, run_period, take_frame
from firmware_py.task_layout import FRAME_ID, FRAME_LENGTH, FRAME_SIZE

_next_period = register_jitable(next_period)


@njit(
    "int64(int32[::1], int64, int64[:,::1], int64[::1], MemoryView(uint8, 1, 'C'), ByteArray(uint8, 1, 'C'))",
    depends=("dbc.node", "dbc.packet", "firmware_py.entry_points", *SOURCES),
)
def _answer_timer(memory, execution_ns, rows, count, packet, answer):  # type: ignore[no-untyped-def]
    """Latch an event's frames, run one control period and answer with what it sends.

    Parameters
    ----------
    memory : array of int32
        See `firmware_py.entry_points.new_memory`.
    execution_ns : int
        From the timer to transmission.
    rows, count : array of int64
        Of the record.
    packet, answer : buffer
        See `dbc.packet`.

    Returns
    -------
    int
        Length of the answer in bytes. `NOT_ANSWERED`, and nothing is changed, if it is another kind of event
        or if the record is full.
    """
    event = np.frombuffer(packet, np.int64)
    if event[KIND] != TIMER or count[0] >= rows.shape[0]:
        return NOT_ANSWERED
    for frame in range(FRAMES, event.size, FRAME_WORDS):
        head = event[frame + 1]
        take_frame(memory, head & ID_MASK, head >> HEAD_DLC, np.uint64(event[frame + 2]))
    now_ns = event[TIME]
    sends = run_period(memory)
    record_period(memory, rows[count[0]], now_ns)
    count[0] += 1
    answered = np.frombuffer(answer, np.int64)
    answered[0] = _next_period(now_ns + 1)
    frames = memory[FRAMES_SENT]
    length = 8
    for number in range(sends):
        frame = number * FRAME_SIZE
        head = np.int64(np.uint32(frames[frame + FRAME_ID]))
        head |= np.int64(frames[frame + FRAME_LENGTH]) << HEAD_DLC
        data = np.int64(data_of(frames, frame))
        length = put_frame(answered, number, now_ns + execution_ns, head, data)
    return length


answer_timer = entry_point(_answer_timer)
