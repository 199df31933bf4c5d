"""The wire's events, compiled: who speaks when, and which node has to be asked next.

All of a wire's state is in integer arrays; frames are SocketCAN's 16 bytes as two 64-bit words: the *head*
(identifier, length << 32) and the data.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import register_jitable

from dbc.frame import EFF_FLAG
from dbc.jit import njit
from hil.bus.link import FRAME, MAX_PACKET, NO_WAKE, TIMER
from hil.bus.wire_time import classic_bits

NEVER = 1 << 62
INTERMISSION_BITS = 3
_NS_PER_S = 1_000_000_000
_ID_MASK = 0xFFFF_FFFF

# words of the wire
(
    NOW,
    END,  # of the frame on the wire, `NEVER` without one
    IDLE,  # when the intermission after the last frame is over
    BIT_RATE,
    PORTS,  # in use
    FILTERS,  # in use
    QUEUED,  # frames handed over and not begun
    LOGGED,  # frames ended
    SEQUENCE,  # frames handed over, ever
    DUE,  # a bit for each port that is to be asked about the frame that has ended
    ON_WIRE_HEAD,
    ON_WIRE_DATA,
    ON_WIRE_SENDER,
) = range(13)
CORE_SIZE = 13

MAX_PORTS = 48
WAKE, PHASE, DRIFT_PPB, MAILED, LINK, EXCHANGES = range(6)
PORT_SIZE = 6
NO_LINK = -1
"""`LINK` of a port whose node is in this process; otherwise it is the descriptor of a SEQPACKET socket."""

# acceptance filters, in the order of their ports, of each port those for every frame last
FILTER_ID, FILTER_PORT, FILTER_LATCHES = range(3)
FILTER_SIZE = 3
EVERY_ID = -1

READY, KEY, SENDER, ORDER, HEAD, DATA, OUT_OF_BAND = range(7)
QUEUE_SIZE = 7

LOG_TIME, LOG_HEAD, LOG_DATA, LOG_SENDER = range(4)
LOG_SIZE = 4

# a port's mail, which is the packet it is asked with: kind, its own time, then three words for each frame
KIND, TIME, FRAMES = range(3)
FRAME_WORDS = 3
MAX_MAIL_FRAMES = 1024
MAIL_SIZE = FRAMES + MAX_MAIL_FRAMES * FRAME_WORDS
MAX_ANSWER_FRAMES = MAX_PACKET // (8 * FRAME_WORDS)

# faults at hand-over
FAULT_ID, FAULT_KIND, FAULT_ARGUMENT, FAULT_COUNT = range(4)
FAULT_SIZE = 4
MAX_FAULTS = 64
DROP, CORRUPT, DELAY, REPEAT = range(1, 5)

NOBODY, NO_ROOM, NO_ANSWER = -1, -2, -16
"""What `advance` returns at its end, when `queue` or `log` have to grow first, and, minus the port, when
nothing came back over its link."""

ON = -3  # nobody to ask about this event

_MSG_NOSIGNAL = 0x4000
_SYSTEM_CALL = types.intp(types.int32, types.uintp, types.uintp, types.int32)
_send: Any = types.ExternalFunction("send", _SYSTEM_CALL)
_recv: Any = types.ExternalFunction("recv", _SYSTEM_CALL)


@njit("int64(int64, int64, int64)")
def local_ns(phase_ns, drift_ppb, bus_ns):  # type: ignore[no-untyped-def]
    """Return the time of a clock at bus time `bus_ns`, ns."""
    elapsed_ns = bus_ns - phase_ns
    whole, rest = elapsed_ns // _NS_PER_S, elapsed_ns % _NS_PER_S  # in two parts: the product would overflow
    return elapsed_ns + whole * drift_ppb + rest * drift_ppb // _NS_PER_S


@njit("int64(int64, int64, int64)")
def bus_ns(phase_ns, drift_ppb, local_ns):  # type: ignore[no-untyped-def]
    """Return the first bus time at which a clock shows `local_ns` or later, ns."""
    rate = _NS_PER_S + drift_ppb
    whole, rest = local_ns // rate, local_ns % rate
    return phase_ns + whole * _NS_PER_S - (-rest * _NS_PER_S // rate)


@njit("int64(int64)")
def arbitration_key(can_id):  # type: ignore[no-untyped-def]
    """Return the number by which identifiers win arbitration: the lower first.

    A standard frame beats an extended one with the same base identifier (ISO 11898-1).
    """
    if can_id & EFF_FLAG:
        return (can_id >> 18 & 0x7FF) << 19 | 1 << 18 | (can_id & 0x3FFFF)
    return can_id << 19


@register_jitable
def _deliver(core, ports, filters, log, mail, head, data, sender):  # type: ignore[no-untyped-def]
    """Log a frame and put it into the mail of every port that accepts it."""
    now_ns = core[NOW]
    row = log[core[LOGGED]]
    row[LOG_TIME], row[LOG_HEAD], row[LOG_DATA], row[LOG_SENDER] = now_ns, head, data, sender
    core[LOGGED] += 1
    can_id = head & _ID_MASK
    served = sender
    for entry in range(core[FILTERS]):
        port = filters[entry, FILTER_PORT]
        if port in (served, sender) or filters[entry, FILTER_ID] not in (can_id, EVERY_ID):
            continue
        served = port
        at = FRAMES + ports[port, MAILED] * FRAME_WORDS
        mail[port, at] = local_ns(ports[port, PHASE], ports[port, DRIFT_PPB], now_ns)
        mail[port, at + 1] = head
        mail[port, at + 2] = data
        ports[port, MAILED] += 1
        if not filters[entry, FILTER_LATCHES] or ports[port, MAILED] == MAX_MAIL_FRAMES:
            core[DUE] |= 1 << port


@register_jitable
def _seal(core, ports, mail, port, kind):  # type: ignore[no-untyped-def]
    """Complete a port's packet and return its length in bytes."""
    mail[port, KIND] = kind
    mail[port, TIME] = local_ns(ports[port, PHASE], ports[port, DRIFT_PPB], core[NOW])
    words = FRAMES + ports[port, MAILED] * FRAME_WORDS
    ports[port, MAILED] = 0
    return words * 8


@register_jitable
def _take(core, queue, entry):  # type: ignore[no-untyped-def]
    """Take an entry out of the queue."""
    core[QUEUED] -= 1
    taken = queue[entry].copy()
    queue[entry] = queue[core[QUEUED]]
    return taken


@register_jitable
def _arbitrate(core, queue):  # type: ignore[no-untyped-def]
    now_ns = core[NOW]
    winner = -1
    for entry in range(core[QUEUED]):
        row = queue[entry]
        if row[OUT_OF_BAND] or row[READY] > now_ns:
            continue
        if winner < 0 or (row[KEY], row[SENDER], row[READY], row[ORDER]) < (
            queue[winner, KEY],
            queue[winner, SENDER],
            queue[winner, READY],
            queue[winner, ORDER],
        ):
            winner = entry
    row = _take(core, queue, winner)
    head = row[HEAD]
    bits = classic_bits(head & _ID_MASK, head >> 32, np.uint64(row[DATA]))
    core[ON_WIRE_HEAD], core[ON_WIRE_DATA], core[ON_WIRE_SENDER] = head, row[DATA], row[SENDER]
    core[END] = now_ns + (bits - INTERMISSION_BITS) * _NS_PER_S // core[BIT_RATE]
    core[IDLE] = now_ns + bits * _NS_PER_S // core[BIT_RATE]


@register_jitable
def _next(core, ports, queue):  # type: ignore[no-untyped-def]
    """Return time, and port or queue entry, of the next wake-up, out-of-band frame and arbitration."""
    port, wake_ns = -1, NEVER
    for number in range(core[PORTS]):
        if ports[number, WAKE] < wake_ns:
            port, wake_ns = number, ports[number, WAKE]
    entry, band_ns, ready_ns = -1, NEVER, NEVER
    for number in range(core[QUEUED]):
        at_ns = queue[number, READY]
        if not queue[number, OUT_OF_BAND]:
            ready_ns = min(ready_ns, at_ns)
        elif at_ns < band_ns or (at_ns == band_ns and queue[number, ORDER] < queue[entry, ORDER]):
            entry, band_ns = number, at_ns
    arbitration_ns = NEVER
    if core[END] == NEVER and ready_ns < NEVER:
        arbitration_ns = max(core[IDLE], core[NOW], ready_ns)
    return port, wake_ns, entry, band_ns, arbitration_ns


@njit("int64(int64[::1], int64[:,::1], int64[:,::1])")
def next_event_ns(core, ports, queue):  # type: ignore[no-untyped-def]
    """Return the bus time of the next event, `NEVER` if there is none."""
    _, wake_ns, _, band_ns, arbitration_ns = _next(core, ports, queue)
    return min(core[END], wake_ns, band_ns, arbitration_ns)


@register_jitable
def _hand_over(core, queue, faults, out_of_band, sender, ready_ns, head, data):  # type: ignore[no-untyped-def]
    can_id = head & _ID_MASK
    for number in range(faults.shape[0]):
        fault = faults[number]
        if fault[FAULT_COUNT] == 0 or fault[FAULT_ID] != can_id:
            continue
        fault[FAULT_COUNT] -= 1
        if fault[FAULT_KIND] == DROP:
            return
        if fault[FAULT_KIND] == CORRUPT:
            data ^= fault[FAULT_ARGUMENT]
        elif fault[FAULT_KIND] == DELAY:
            ready_ns += fault[FAULT_ARGUMENT]
        elif fault[FAULT_KIND] == REPEAT:
            data = fault[FAULT_ARGUMENT]
    row = queue[core[QUEUED]]
    row[READY] = max(ready_ns, core[NOW])
    row[KEY] = arbitration_key(can_id)
    row[SENDER] = sender
    row[ORDER] = core[SEQUENCE]
    row[HEAD] = head
    row[DATA] = data
    row[OUT_OF_BAND] = can_id in out_of_band
    core[QUEUED] += 1
    core[SEQUENCE] += 1


@register_jitable
def _next_question(core, ports, filters, queue, log, mail, until_ns):  # type: ignore[no-untyped-def]
    """Process one event; return the port it asks, `NOBODY` at the end or `ON`, and the packet's length."""
    if core[DUE]:
        for port in range(core[PORTS]):
            if core[DUE] & 1 << port:
                core[DUE] ^= 1 << port
                return port, _seal(core, ports, mail, port, FRAME)
    port, wake_ns, entry, band_ns, arbitration_ns = _next(core, ports, queue)
    end_ns = core[END]
    event_ns = min(end_ns, wake_ns, band_ns, arbitration_ns)
    if event_ns >= until_ns:
        core[NOW] = max(core[NOW], until_ns)
        return NOBODY, 0
    core[NOW] = event_ns
    if event_ns == end_ns:
        core[END] = NEVER
        head, data, sender = core[ON_WIRE_HEAD], core[ON_WIRE_DATA], core[ON_WIRE_SENDER]
        _deliver(core, ports, filters, log, mail, head, data, sender)
    elif event_ns == wake_ns:
        ports[port, WAKE] = NEVER
        return port, _seal(core, ports, mail, port, TIMER)
    elif event_ns == band_ns:
        row = _take(core, queue, entry)
        _deliver(core, ports, filters, log, mail, row[HEAD], row[DATA], row[SENDER])
    else:
        _arbitrate(core, queue)
    return ON, 0


@njit(
    "void(int64[::1], int64[:,::1], int64[:,::1], int64[::1], int64, int64, int64, int64)",
    depends=("dbc.frame", "hil.bus.link"),
)
def hand_over(core, queue, faults, out_of_band, sender, ready_ns, head, data):  # type: ignore[no-untyped-def]
    """Hand a frame to its sender's CAN controller at bus time `ready_ns`, now or later."""
    _hand_over(core, queue, faults, out_of_band, sender, ready_ns, head, data)


@register_jitable
def _apply(core, ports, queue, faults, out_of_band, answer, length, port):  # type: ignore[no-untyped-def]
    """Do what a node wants: `answer` is in times of its own clock."""
    phase_ns, drift_ppb = ports[port, PHASE], ports[port, DRIFT_PPB]
    if answer[0] != NO_WAKE:
        ports[port, WAKE] = max(bus_ns(phase_ns, drift_ppb, answer[0]), core[NOW])
    for at in range(1, length // 8, FRAME_WORDS):
        ready_ns = bus_ns(phase_ns, drift_ppb, answer[at])
        _hand_over(core, queue, faults, out_of_band, port, ready_ns, answer[at + 1], answer[at + 2])


@register_jitable
def _exchange(ports, mail, answer, port, length):  # type: ignore[no-untyped-def]
    """Send a port's packet over its link; return the length of the answer, 0 or less if there is none."""
    ports[port, EXCHANGES] += 1
    link = ports[port, LINK]
    if _send(link, mail[port].ctypes.data, length, _MSG_NOSIGNAL) < 0:
        return 0
    return _recv(link, answer.ctypes.data, MAX_PACKET, 0)


@njit(
    "int64(int64[::1], int64[:,::1], int64[:,::1], int64[:,::1], int64[::1], int64[::1],"
    " int64[:,::1], int64[:,::1], int64[:,::1], int64, int64, int64)",
    depends=("hil.bus.wire_time", "hil.bus.link", "dbc.frame"),
)
def advance(  # type: ignore[no-untyped-def]
    core, ports, mail, faults, out_of_band, answer, filters, queue, log, length, port, until_ns
):
    """Process events before `until_ns`, up to the next one that a node in this process has to be asked about.

    Parameters
    ----------
    answer : array of int64
        What `port` answered: when it wants to wake, or `NO_WAKE`; then time, head and data of each frame.
    length : int
        Of the answer, in bytes; 0 if there is none.

    Returns
    -------
    int
        ``length of the packet << 8 | port`` of the node to ask, `NOBODY`, `NO_ROOM`, or `NO_ANSWER` - port.
    """
    if length:
        _apply(core, ports, queue, faults, out_of_band, answer, length, port)
    while True:
        if core[LOGGED] == log.shape[0] or core[QUEUED] + MAX_ANSWER_FRAMES > queue.shape[0]:
            return NO_ROOM
        asked, length = _next_question(core, ports, filters, queue, log, mail, until_ns)
        if asked == ON:
            continue
        if asked < 0:
            return NOBODY
        if ports[asked, LINK] == NO_LINK:
            return length << 8 | asked
        length = _exchange(ports, mail, answer, asked, length)
        if length <= 0:
            return NO_ANSWER - asked
        _apply(core, ports, queue, faults, out_of_band, answer, length, asked)
