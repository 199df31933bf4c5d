"""The plant's interrupts in one compiled call, for the events that make up nearly all of a run."""

import numpy as np

from dbc.jit import njit
from dbc.node import PERIOD_NS
from dbc.packet import FRAME_WORDS, FRAMES, HEAD_DLC, ID_MASK, KIND, NOT_ANSWERED, TIME, TIMER, put_frame
from dbc.profile2 import DLC
from plant_sim import period
from plant_sim.period import run_period


@njit(
    "int64(int64, int64, float64[::1], float64[::1], float64[::1], int64[::1], int64[::1], int64[::1],"
    " int64[::1], int64[::1], int64[::1], float64[:,::1], int64[::1], MemoryView(uint8, 1, 'C'),"
    " ByteArray(uint8, 1, 'C'))",
    depends=("dbc", "plant_sim"),
)
def answer_timer(  # type: ignore[no-untyped-def]
    command_id,
    feedback_head,
    state,
    parameters,
    row,
    drive,
    receiver,
    command,
    counter,
    feedback,
    sensor,
    rows,
    count,
    packet,
    answer,
):
    """Take the newest DriveCommand of an event, run one period and answer with PositionFeedback.

    Parameters
    ----------
    command_id, feedback_head : int
        Identifier of DriveCommand, head of the frame that carries PositionFeedback.
    state, parameters, row, drive, receiver, command, counter, feedback, sensor
        See `plant_sim.period.run_period`.
    rows, count : array
        Of the record.
    packet, answer : buffer
        See `dbc.packet`.

    Returns
    -------
    int
        Length of the answer in bytes. `NOT_ANSWERED`, and nothing is changed, if it is another kind of event,
        if there is a frame that is no DriveCommand, or if the record is full.
    """
    event = np.frombuffer(packet, np.int64)
    if event[KIND] != TIMER or count[0] >= rows.shape[0]:
        return NOT_ANSWERED
    length, data = 0, 0
    for frame in range(FRAMES, event.size, FRAME_WORDS):
        if event[frame + 1] & ID_MASK != command_id:
            return NOT_ANSWERED
        length, data = event[frame + 1] >> HEAD_DLC, event[frame + 2]
    now_ns = event[TIME]
    periods = (now_ns - np.int64(row[period.TIME])) // PERIOD_NS
    payload = run_period(
        state,
        parameters,
        row,
        drive,
        receiver,
        command,
        counter,
        feedback,
        sensor,
        periods,
        np.uint64(data),
        length == command[DLC],
        0.0,
    )
    rows[count[0]] = row
    count[0] += 1
    answered = np.frombuffer(answer, np.int64)
    answered[0] = np.int64(row[period.TIME]) + PERIOD_NS
    return put_frame(answered, 0, now_ns, feedback_head, np.int64(payload))
