"""The wire's events, compiled: who speaks when, and which node has to be asked next.

All of a wire's state is in integer arrays; frames are SocketCAN's 16 bytes as two 64-bit words: the *head*
(identifier, length << 32) and the data. A CAN FD frame has its flags in bits 40 to 42 of the head, and for
its data the word of `hil.bus.wire_time.fd_log_data`: the payload is elsewhere.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import register_jitable

from dbc.frame import EFF_FLAG, ERR_FLAG
from dbc.jit import njit
from dbc.packet import FRAME, FRAME_WORDS, FRAMES, ID_MASK, KIND, NO_WAKE, TIME, TIMER
from hil.bus.confinement import (
    ERROR_DELIMITER_BITS,
    ERROR_FLAG_BITS,
    REC,
    SEQUENCE_BITS,
    SEQUENCES_LEFT,
    SUSPEND_BITS,
    SUSPENDED_UNTIL,
    TEC,
    after_error,
    after_success,
    count_sequences,
    first_bad_bit,
    is_passive,
    next_random,
)
from hil.bus.link import MAX_PACKET
from hil.bus.wire_time import (
    ERROR_BITS_BYTE,
    ERROR_MORE_BITS_BYTE,
    FAST_SHIFT,
    INTERMISSION_BITS,
    LENGTH_MASK,
    UNSTUFFED_BITS,
    classic_bits,
)

NEVER = 1 << 62
_NS_PER_S = 1_000_000_000
FLAGS_SHIFT = 40
"""Of the head of a CAN FD frame; a classic one has no bits from here on."""

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
    ON_WIRE_READY,
    ON_WIRE_ORDER,
    ON_WIRE_BAD_BITS,  # bits up to the end of the error frame that destroys it, 0 if it arrives
    ON_WIRE_BAD_FAST,  # those of them that are at the data rate come on top
    BUS_OFF,  # whether a node is
    COUNTED_UNTIL,  # bus time up to which idle bits have been counted for bus-off nodes, ns
    NOISE_UNTIL,  # end of the noise, ns
    NOISE_LEVEL,  # probability that a bit is bad, per billion
    NOISE_STATE,  # of its random numbers
    BABBLE_GAP,  # from the end of a babbled frame's intermission to the next frame, ns
    BABBLE_UNTIL,  # bus time from which no further one is handed over, ns
    DATA_BIT_RATE,
    FAULTS,  # rows in use
) = range(26)
CORE_SIZE = 26

MAX_PORTS = 48
BABBLER = 1 << 30
"""The babbling sender, which is no node: it has no error counters, and of equal identifiers it loses."""

WAKE, PHASE, DRIFT_PPB, MAILED, LINK, EXCHANGES = range(6)  # then those of `hil.bus.confinement`
PORT_SIZE = 10
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

# a port's mail is the packet it is asked with, see `dbc.packet`
MAX_MAIL_FRAMES = 1024
MAIL_SIZE = FRAMES + MAX_MAIL_FRAMES * FRAME_WORDS
MAX_ANSWER_FRAMES = MAX_PACKET // (8 * FRAME_WORDS)

# faults, the last kind when a frame begins, the others at hand-over
FAULT_ID, FAULT_KIND, FAULT_ARGUMENT, FAULT_COUNT = range(4)
FAULT_SIZE = 4
MAX_FAULTS = 64
DROP, CORRUPT, DELAY, REPEAT, DESTROY = range(1, 6)

# an error frame in the log, as Linux shows it (linux/can/error.h)
ERROR_CLASSES = 0x08 | 0x200  # a protocol violation; error counters are given
ERROR_BUS_OFF = 0x40
_ERROR_BIT_TYPE = 0x01  # byte 2: a single bit
_TEC_BYTE, _REC_BYTE = 6, 7

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
    """Log a frame and put it into the mail of every port that accepts it; CAN FD is for none."""
    now_ns = core[NOW]
    row = log[core[LOGGED]]
    row[LOG_TIME], row[LOG_HEAD], row[LOG_DATA], row[LOG_SENDER] = now_ns, head, data, sender
    core[LOGGED] += 1
    if head >> FLAGS_SHIFT:
        return
    can_id = head & ID_MASK
    served = sender
    for entry in range(core[FILTERS]):
        port = filters[entry, FILTER_PORT]
        if port in (served, sender) or filters[entry, FILTER_ID] not in (can_id, EVERY_ID):
            continue
        if ports[port, SEQUENCES_LEFT]:
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
def _bits_ns(core, bits):  # type: ignore[no-untyped-def]
    return bits * _NS_PER_S // core[BIT_RATE]


@register_jitable
def _both_ns(core, bits, fast):  # type: ignore[no-untyped-def]
    """Return how long bits at the nominal and bits at the data rate take."""
    if fast == 0:
        return _bits_ns(core, bits)
    rate, data_rate = core[BIT_RATE], core[DATA_BIT_RATE]
    return (bits * data_rate + fast * rate) * _NS_PER_S // (rate * data_rate)


@register_jitable
def _let_recover(core, ports):  # type: ignore[no-untyped-def]
    """Count the idle bits up to now for bus-off nodes."""
    if not core[BUS_OFF] or core[END] != NEVER:
        return
    idle_ns = core[NOW] - max(core[IDLE], core[COUNTED_UNTIL])
    sequences = idle_ns * core[BIT_RATE] // (_NS_PER_S * SEQUENCE_BITS)
    if sequences > 0:
        core[COUNTED_UNTIL] = max(core[IDLE], core[COUNTED_UNTIL]) + _bits_ns(core, sequences * SEQUENCE_BITS)
        core[BUS_OFF] = count_sequences(ports, core[PORTS], sequences)


@register_jitable
def _suspended_until(core, ports, sender):  # type: ignore[no-untyped-def]
    return ports[sender, SUSPENDED_UNTIL] if sender < core[PORTS] else 0


@register_jitable
def _bad_bit(core, faults, can_id, bits):  # type: ignore[no-untyped-def]
    """Return at which bit the frame that begins is destroyed, -1 if it is not."""
    for number in range(core[FAULTS]):
        if faults[number, FAULT_COUNT] == 0 or faults[number, FAULT_ID] != can_id:
            continue
        if faults[number, FAULT_KIND] == DESTROY:
            faults[number, FAULT_COUNT] -= 1
            return min(faults[number, FAULT_ARGUMENT], bits - 1)
    if core[NOW] < core[NOISE_UNTIL]:
        state, uniform = next_random(np.uint64(core[NOISE_STATE]))
        core[NOISE_STATE] = np.int64(state)
        good_bits = first_bad_bit(uniform, core[NOISE_LEVEL])
        if good_bits < bits:
            return good_bits
    return -1


@register_jitable
def _arbitrate(core, ports, queue, faults):  # type: ignore[no-untyped-def]
    _let_recover(core, ports)
    now_ns = core[NOW]
    winner = -1
    for entry in range(core[QUEUED]):
        row = queue[entry]
        if row[OUT_OF_BAND] or row[READY] > now_ns or _suspended_until(core, ports, row[SENDER]) > now_ns:
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
    fast = 0
    if head >> FLAGS_SHIFT:
        bits, fast = row[DATA] & LENGTH_MASK, row[DATA] >> FAST_SHIFT & LENGTH_MASK
    else:
        bits = classic_bits(head & ID_MASK, head >> 32, np.uint64(row[DATA]))
    core[ON_WIRE_HEAD], core[ON_WIRE_DATA], core[ON_WIRE_SENDER] = head, row[DATA], row[SENDER]
    core[ON_WIRE_READY], core[ON_WIRE_ORDER] = row[READY], row[ORDER]
    bad_bit = _bad_bit(core, faults, head & ID_MASK, bits + fast - INTERMISSION_BITS)
    core[ON_WIRE_BAD_BITS] = core[ON_WIRE_BAD_FAST] = 0
    if bad_bit >= 0:
        if fast:  # these follow the bit rate switch, before the acknowledgement
            fast = min(max(bad_bit + 1 - (bits - UNSTUFFED_BITS + 1), 0), fast)
        core[ON_WIRE_BAD_BITS] = bad_bit + 1 - fast + ERROR_FLAG_BITS + ERROR_DELIMITER_BITS
        core[ON_WIRE_BAD_FAST] = fast
        bits = core[ON_WIRE_BAD_BITS] + INTERMISSION_BITS
    core[END] = now_ns + _both_ns(core, bits - INTERMISSION_BITS, fast)
    core[IDLE] = now_ns + _both_ns(core, bits, fast)


@register_jitable
def _enqueue(core, queue, ready_ns, sender, head, data):  # type: ignore[no-untyped-def]
    """Let a frame take part in arbitration from `ready_ns` on."""
    row = queue[core[QUEUED]]
    row[READY], row[SENDER], row[ORDER], row[HEAD], row[DATA] = ready_ns, sender, core[SEQUENCE], head, data
    row[KEY] = arbitration_key(head & ID_MASK)
    row[OUT_OF_BAND] = 0
    core[QUEUED] += 1
    core[SEQUENCE] += 1


@register_jitable
def _withdraw(core, queue, sender):  # type: ignore[no-untyped-def]
    """Forget what a sender has handed over and that has not begun."""
    kept = 0
    for entry in range(core[QUEUED]):
        if queue[entry, SENDER] != sender:
            queue[kept] = queue[entry]
            kept += 1
    core[QUEUED] = kept


@register_jitable
def _destroyed(core, ports, queue, log):  # type: ignore[no-untyped-def]
    """Log the error frame of what was on the wire; it is sent again unless its sender is bus-off."""
    sender, head = core[ON_WIRE_SENDER], core[ON_WIRE_HEAD]
    is_off = after_error(ports, core[PORTS], sender)
    core[BUS_OFF] = count_sequences(ports, core[PORTS], 0)
    row = log[core[LOGGED]]
    row[LOG_TIME], row[LOG_SENDER] = core[NOW], sender
    row[LOG_HEAD] = ERR_FLAG | ERROR_CLASSES | (ERROR_BUS_OFF if is_off else 0) | 8 << 32
    bits = core[ON_WIRE_BAD_BITS]
    data = _ERROR_BIT_TYPE << 16 | (bits & 0xFF) << 8 * ERROR_BITS_BYTE | core[ON_WIRE_BAD_FAST]
    data |= (bits >> 8) << 8 * ERROR_MORE_BITS_BYTE
    if sender < core[PORTS]:
        data |= min(ports[sender, TEC], 255) << 8 * _TEC_BYTE
        data |= ports[sender, REC] << 8 * _REC_BYTE
    row[LOG_DATA] = data
    core[LOGGED] += 1
    if is_off:
        _withdraw(core, queue, sender)
        return
    _enqueue(core, queue, core[ON_WIRE_READY], sender, head, core[ON_WIRE_DATA])
    queue[core[QUEUED] - 1, ORDER] = core[ON_WIRE_ORDER]


@register_jitable
def _ended(core, ports, filters, queue, log, mail):  # type: ignore[no-untyped-def]
    """Do what the end of the frame on the wire brings."""
    sender = core[ON_WIRE_SENDER]
    core[END] = NEVER
    core[BUS_OFF] = core[BUS_OFF] and count_sequences(ports, core[PORTS], 1)  # its end and the intermission
    if core[ON_WIRE_BAD_BITS]:
        _destroyed(core, ports, queue, log)
    else:
        after_success(ports, core[PORTS], sender)
        _deliver(core, ports, filters, log, mail, core[ON_WIRE_HEAD], core[ON_WIRE_DATA], sender)
        if sender == BABBLER and core[IDLE] + core[BABBLE_GAP] < core[BABBLE_UNTIL]:
            _enqueue(
                core, queue, core[IDLE] + core[BABBLE_GAP], sender, core[ON_WIRE_HEAD], core[ON_WIRE_DATA]
            )
    if sender < core[PORTS] and is_passive(ports[sender]):
        ports[sender, SUSPENDED_UNTIL] = core[IDLE] + _bits_ns(core, SUSPEND_BITS)


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
            ready_ns = min(ready_ns, max(at_ns, _suspended_until(core, ports, queue[number, SENDER])))
        elif at_ns < band_ns or (at_ns == band_ns and queue[number, ORDER] < queue[entry, ORDER]):
            entry, band_ns = number, at_ns
    arbitration_ns = NEVER
    if core[END] == NEVER and ready_ns < NEVER:
        arbitration_ns = max(core[IDLE], core[NOW], ready_ns)
    return port, wake_ns, entry, band_ns, arbitration_ns


@njit("void(int64[::1], int64[:,::1], int64, int64, int64)", depends=("dbc.frame",))
def enqueue(core, queue, sender, head, data):  # type: ignore[no-untyped-def]
    """Let a frame take part in arbitration from now on, untouched by the faults of `hand_over`."""
    _enqueue(core, queue, core[NOW], sender, head, data)


@njit("void(int64[::1], int64[:,::1])", depends=("hil.bus.confinement",))
def let_recover(core, ports):  # type: ignore[no-untyped-def]
    """Count the idle bits up to now for bus-off nodes."""
    _let_recover(core, ports)


@njit("int64(int64[::1], int64[:,::1], int64[:,::1])", depends=("hil.bus.confinement",))
def next_event_ns(core, ports, queue):  # type: ignore[no-untyped-def]
    """Return the bus time of the next event, `NEVER` if there is none."""
    _, wake_ns, _, band_ns, arbitration_ns = _next(core, ports, queue)
    return min(core[END], wake_ns, band_ns, arbitration_ns)


@register_jitable
def _hand_over(core, ports, queue, faults, out_of_band, sender, ready_ns, head, data):  # type: ignore[no-untyped-def]
    can_id = head & ID_MASK
    if core[BUS_OFF] and sender < core[PORTS]:
        _let_recover(core, ports)
        if ports[sender, SEQUENCES_LEFT]:
            return
    if head >> FLAGS_SHIFT:
        _enqueue(core, queue, max(ready_ns, core[NOW]), sender, head, data)
        return
    for number in range(core[FAULTS]):
        if faults[number, FAULT_COUNT] == 0 or faults[number, FAULT_ID] != can_id:
            continue
        fault = faults[number]
        if fault[FAULT_KIND] == DESTROY:
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
    _enqueue(core, queue, max(ready_ns, core[NOW]), sender, head, data)
    queue[core[QUEUED] - 1, OUT_OF_BAND] = can_id in out_of_band


@register_jitable
def _next_question(core, ports, filters, queue, log, mail, faults, until_ns):  # type: ignore[no-untyped-def]
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
        _ended(core, ports, filters, queue, log, mail)
    elif event_ns == wake_ns:
        ports[port, WAKE] = NEVER
        return port, _seal(core, ports, mail, port, TIMER)
    elif event_ns == band_ns:
        row = _take(core, queue, entry)
        _deliver(core, ports, filters, log, mail, row[HEAD], row[DATA], row[SENDER])
    else:
        _arbitrate(core, ports, queue, faults)
    return ON, 0


@njit(
    "void(int64[::1], int64[:,::1], int64[:,::1], int64[:,::1], int64[::1], int64, int64, int64, int64)",
    depends=("dbc.frame", "hil.bus.confinement", "hil.bus.link", "dbc.packet"),
)
def hand_over(core, ports, queue, faults, out_of_band, sender, ready_ns, head, data):  # type: ignore[no-untyped-def]
    """Hand a frame to its sender's CAN controller at bus time `ready_ns`; bus-off ones take none."""
    _hand_over(core, ports, queue, faults, out_of_band, sender, ready_ns, head, data)


@register_jitable
def _apply(core, ports, queue, faults, out_of_band, answer, length, port):  # type: ignore[no-untyped-def]
    """Do what a node wants: `answer` is in times of its own clock."""
    phase_ns, drift_ppb = ports[port, PHASE], ports[port, DRIFT_PPB]
    if answer[0] != NO_WAKE:
        ports[port, WAKE] = max(bus_ns(phase_ns, drift_ppb, answer[0]), core[NOW])
    for at in range(1, length // 8, FRAME_WORDS):
        ready_ns = bus_ns(phase_ns, drift_ppb, answer[at])
        _hand_over(core, ports, queue, faults, out_of_band, port, ready_ns, answer[at + 1], answer[at + 2])


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
    depends=("hil.bus.confinement", "hil.bus.wire_time", "hil.bus.link", "dbc.frame", "dbc.packet"),
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
        asked, length = _next_question(core, ports, filters, queue, log, mail, faults, until_ns)
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
