"""The supervisor's answer in a period in which it sends nothing but a setpoint: one compiled call."""

import numpy as np

from dbc import e2e
from dbc.jit import njit
from dbc.node import PERIOD_NS
from dbc.packet import KIND, NOT_ANSWERED, TIME, TIMER, put_frame
from dbc.profile2 import CONFIGURATION_SIZE

_POSITION_START = CONFIGURATION_SIZE
_POSITION_MASK = 0xFFFF_FFFF


@njit(
    "int64(int64, int64[::1], int64[::1], float64[::1], int64[::1], int64, int64, float64, float64[:,::1],"
    " int64[::1], MemoryView(uint8, 1, 'C'), ByteArray(uint8, 1, 'C'))",
    depends=("dbc",),
)
def answer_setpoint(  # type: ignore[no-untyped-def]
    head, layout, counter, references_m, setpoints, index, due_ns, load_n, rows, count, packet, answer
):
    """Answer the timer's event with a setpoint.

    Parameters
    ----------
    head : int
        Of the frame that carries PositionSetpoint.
    layout : array of int64
        PositionSetpoint's, from `dbc.codec.MessageCodec.protected_layout`.
    counter : array of int64, shape (1,)
        E2E counter of PositionSetpoint.
    references_m, setpoints : array of float64 and int64
        Reference in m and in counts of the setpoint, one for each of the periods to come.
    index : int
        Of this period among them.
    due_ns : int
        When this period begins.
    load_n : float
        For the record.
    rows, count : array
        Of the record.
    packet, answer : buffer
        See `dbc.packet`.

    Returns
    -------
    int
        Length of the answer in bytes. `NOT_ANSWERED`, and nothing is changed, if it is another kind of event,
        if it is late, or if the record is full.
    """
    event = np.frombuffer(packet, np.int64)
    if event[KIND] != TIMER or event[TIME] != due_ns or count[0] >= rows.shape[0]:
        return NOT_ANSWERED
    row = rows[count[0]]
    row[0], row[1], row[2], row[3] = due_ns, references_m[index], setpoints[index], load_n
    count[0] += 1
    payload = np.uint64((setpoints[index] & _POSITION_MASK) << layout[_POSITION_START])
    answered = np.frombuffer(answer, np.int64)
    answered[0] = due_ns + PERIOD_NS
    protected = e2e.profile2_protect(counter, layout[:CONFIGURATION_SIZE], payload)
    return put_frame(answered, 0, due_ns, head, np.int64(protected))
