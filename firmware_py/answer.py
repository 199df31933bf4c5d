"""The controller's interrupts in one compiled call, for the events that make up nearly all of a run."""

import numpy as np
from numba.extending import register_jitable

from dbc.jit import njit
from dbc.node import next_period
from dbc.packet import FRAME_WORDS, FRAMES, HEAD_DLC, ID_MASK, KIND, NOT_ANSWERED, TIME, TIMER
from firmware_py.mailbox import receive
from firmware_py.task import period

_next_period = register_jitable(next_period)


@register_jitable
def _mailbox_of(ids, head):  # type: ignore[no-untyped-def]
    """Return the number of the mailbox that a frame belongs to, -1 if there is none."""
    for number in range(ids.size):
        if ids[number] == head & ID_MASK:
            return number
    return -1


@njit(
    "int64(int64[::1], int64, int64, int64[:,::1], int64[:,::1], int64[::1], int64[::1], int32[::1],"
    " int32[::1], int32[::1], int64[:,::1], int64[::1], MemoryView(uint8, 1, 'C'), ByteArray(uint8, 1, 'C'))",
    depends=("dbc", "firmware_py"),
)
def answer_timer(  # type: ignore[no-untyped-def]
    ids,
    head,
    execution_ns,
    mailboxes,
    expectations,
    layout,
    task,
    calibration,
    state,
    io,
    rows,
    count,
    packet,
    answer,
):
    """Latch an event's frames, run one control period and answer with DriveCommand.

    Parameters
    ----------
    ids : array of int64
        Identifiers of the messages that have a mailbox.
    head : int
        Head of the frame that carries DriveCommand.
    execution_ns : int
        From the timer to its transmission.
    mailboxes, expectations, layout, task, calibration, state, io : array
        See `firmware_py.task.period`.
    rows, count : array of int64
        Of the record.
    packet, answer : buffer
        See `dbc.packet`.

    Returns
    -------
    int
        Length of the answer in bytes. `NOT_ANSWERED`, and nothing is changed, if it is another kind of event,
        if a frame has no mailbox, or if the record is full.
    """
    event = np.frombuffer(packet, np.int64)
    if event[KIND] != TIMER or count[0] >= rows.shape[0]:
        return NOT_ANSWERED
    for frame in range(FRAMES, event.size, FRAME_WORDS):
        if _mailbox_of(ids, event[frame + 1]) < 0:
            return NOT_ANSWERED
    for frame in range(FRAMES, event.size, FRAME_WORDS):
        mailbox = mailboxes[_mailbox_of(ids, event[frame + 1])]
        receive(mailbox, np.uint64(event[frame + 2]), event[frame + 1] >> HEAD_DLC)
    now_ns = event[TIME]
    payload = period(mailboxes, expectations, layout, task, calibration, state, io, rows[count[0]], now_ns)
    count[0] += 1
    answered = np.frombuffer(answer, np.int64)
    answered[0] = _next_period(now_ns + 1)
    answered[1] = now_ns + execution_ns
    answered[2] = head
    answered[3] = np.int64(payload)
    return 32
