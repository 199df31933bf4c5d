"""The wire: a discrete-event simulation that owns time and decides who speaks when.

Time is integer nanoseconds. The next event is the earliest of a frame's end, a node's wake-up, an out-of-band
frame, and arbitration; at the same instant they come in this order, and wake-ups in the order in which the
nodes were attached. `hil.bus.wire_core` processes the events; here nodes come, go and are asked.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial
from typing import Any

import numpy as np

from dbc.frame import FD_FLAG, Frame
from dbc.jit import entry_point
from dbc.node import Actions, Node
from dbc.packet import START, answers_of, pack_actions_into, unpack_actions
from hil.bus import confinement, link
from hil.bus import wire_core as at
from hil.bus.wire_core import NEVER, arbitration_key
from hil.bus.wire_time import PAYLOAD_SHIFT, fd_bits, fd_log_data, payload_words

__all__ = ["NEVER", "Clock", "FrameFault", "Port", "Wire", "arbitration_key"]

_advance, _hand_over = entry_point(at.advance), entry_point(at.hand_over)
_local_ns, _bus_ns = entry_point(at.local_ns), entry_point(at.bus_ns)
_QUEUE_ROWS = 4096
_LOG_ROWS = 1 << 14
_PAYLOADS = 1 << 31

DEFAULT_DATA_BIT_RATE = 5_000_000
"""Bit/s: the highest for which ISO 11898-2:2016 specifies transceivers."""

Edit = Callable[[Actions], Actions]
"""Changes what a node wants before the wire hears of it; times are those of the node's own clock."""


@dataclass(frozen=True, slots=True)
class Clock:
    """A node's own clock: it starts `phase_ns` after bus time 0 and runs `drift_ppb` fast."""

    phase_ns: int = 0
    drift_ppb: int = 0

    def local(self, bus_ns: int) -> int:
        """Return the node's time at bus time `bus_ns`, ns."""
        return int(_local_ns(self.phase_ns, self.drift_ppb, bus_ns))

    def bus(self, local_ns: int) -> int:
        """Return the first bus time at which the node's clock shows `local_ns` or later, ns."""
        return int(_bus_ns(self.phase_ns, self.drift_ppb, local_ns))


class FrameFault(IntEnum):
    """What can happen to a frame between its node and the wire; the argument in brackets.

    Only `DESTROY` strikes CAN FD frames, too.

    Attributes
    ----------
    DROP
        It is never sent.
    CORRUPT
        Payload bits are flipped [the payload's bits, byte 0 in the low eight].
    DELAY
        It is handed over later [ns].
    REPEAT
        It carries the payload of the last one before the fault.
    DESTROY
        It begins, and an error frame ends it; it is sent again [the bit that is hit, 0 being its start].
    """

    DROP = at.DROP
    CORRUPT = at.CORRUPT
    DELAY = at.DELAY
    REPEAT = at.REPEAT
    DESTROY = at.DESTROY


@dataclass(frozen=True, slots=True)
class ErrorState:
    """A node's part in fault confinement: both counters, and what follows from them.

    Attributes
    ----------
    name : str
        "error-active", "error-passive" or "bus-off".
    tec, rec : int
        Transmit and receive error counter.
    """

    name: str
    tec: int
    rec: int


class LocalNode:
    """A node in this process, asked as one in another process is."""

    def __init__(self, node: Node) -> None:
        self.name, self.accepts, self.latched = node.name, node.accepts, node.latched
        self.link = at.NO_LINK
        self.ask = answers_of(node)

    def late_answer(self, answer: bytearray) -> int:
        """Never be needed: there is no link."""
        raise AssertionError


@dataclass(slots=True, eq=False)
class Port:
    """A node's place on the wire."""

    node: "LocalNode | link.Askable"
    order: int
    clock: Clock
    packet: memoryview
    ask: Callable[[memoryview, bytearray], int]
    connected: bool = True
    plugged_in: bool = True
    edits: list[Edit] = field(default_factory=list)


class Wire:
    """A CAN bus between nodes.

    Nodes are classic: they let CAN FD frames pass, unheard and undestroyed. Such frames come from senders
    that are no nodes.

    Parameters
    ----------
    bit_rate : int
        Bit/s; of CAN FD frames the nominal one.
    out_of_band : frozenset of int
        Ids of the bench channel: delivered the moment they are sent, without using the bus.
    data_bit_rate : int
        Bit/s of CAN FD frames behind their bit rate switch.
    """

    def __init__(
        self,
        bit_rate: int,
        out_of_band: frozenset[int] = frozenset(),
        data_bit_rate: int = DEFAULT_DATA_BIT_RATE,
    ) -> None:
        self.bit_rate = bit_rate
        self.data_bit_rate = data_bit_rate
        self._core = np.zeros(at.CORE_SIZE, np.int64)
        self._core[at.END] = NEVER
        self._core[[at.BIT_RATE, at.DATA_BIT_RATE]] = bit_rate, data_bit_rate
        self._port_words = np.zeros((at.MAX_PORTS, at.PORT_SIZE), np.int64)
        self._filters = np.zeros((0, at.FILTER_SIZE), np.int64)
        self._queue = np.zeros((_QUEUE_ROWS, at.QUEUE_SIZE), np.int64)
        self._log = np.zeros((_LOG_ROWS, at.LOG_SIZE), np.int64)
        self._mail = np.zeros((at.MAX_PORTS, at.MAIL_SIZE), np.int64)
        self._faults = np.zeros((at.MAX_FAULTS, at.FAULT_SIZE), np.int64)
        self._out_of_band = np.array(sorted(out_of_band), np.int64)
        self._answer = bytearray(link.MAX_PACKET)
        self._payloads: dict[int, np.ndarray] = {}
        self._next_payload = 0
        self._advance = partial(
            _advance,
            self._core,
            self._port_words,
            self._mail,
            self._faults,
            self._out_of_band,
            np.frombuffer(self._answer, np.int64),
        )
        self._ports: list[Port] = []

    @property
    def now_ns(self) -> int:
        """Bus time, ns."""
        return int(self._core[at.NOW])

    @property
    def log(self) -> np.ndarray:
        """Frames that have ended, int64 of shape (frames, 4): end ns, head, data, sender; see `wire_core`."""
        return self._log[: self._core[at.LOGGED]]

    @property
    def traffic(self) -> np.ndarray:
        """Frames that have ended, uint64 of shape (frames, 4): bus time of the end (ns), id, dlc, data.

        Of CAN FD frames, which have `dbc.frame.FD_FLAG` in their id, the data are as `wire_time.fd_log_data`
        says, the row being one of `payloads`.
        """
        head = self.log[:, at.LOG_HEAD]
        can_id, dlc = _id_and_dlc(head)
        data = self.log[:, at.LOG_DATA].copy()
        fd = np.flatnonzero(can_id & FD_FLAG)
        data[fd] = data[fd] & ((1 << PAYLOAD_SHIFT) - 1) | np.arange(len(fd)) << PAYLOAD_SHIFT
        return np.column_stack([self.log[:, at.LOG_TIME], can_id, dlc, data]).view(np.uint64)

    @property
    def payloads(self) -> np.ndarray:
        """Payloads of the CAN FD frames of `traffic` in their order, uint64 of shape (frames, 8)."""
        log = self.log
        of_fd = log[log[:, at.LOG_HEAD] >> at.FLAGS_SHIFT > 0, at.LOG_DATA] >> PAYLOAD_SHIFT
        rows = [self._payloads[number] for number in of_fd.tolist()]
        return np.array(rows, np.uint64).reshape(-1, 8)

    def logged(self, row: int) -> tuple[int, Frame]:
        """Return end (bus time, ns) and frame in a row of the log."""
        time_ns, head, data, _ = self.log[row].tolist()
        can_id, dlc = _id_and_dlc(head)
        if can_id & FD_FLAG:
            data = int.from_bytes(self._payloads[data >> PAYLOAD_SHIFT].tobytes(), "little")
        return time_ns, Frame(can_id, dlc, data % (1 << 64) if data < 0 else data)

    def attach(self, node: "Node | link.Askable", clock: Clock | None = None) -> Port:
        """Add a node; it hears the frames that end from now on.

        Raises
        ------
        ValueError
            If a node of that name is there already, or there are too many.
        """
        if any(port.connected and port.node.name == node.name for port in self._ports):
            raise ValueError(f"there is a node named {node.name!r} on this bus already")
        order = len(self._ports)
        if order == at.MAX_PORTS:
            raise ValueError(f"a wire has room for {at.MAX_PORTS} nodes")
        clock = clock or Clock()
        asked = node if isinstance(node, link.Askable) else LocalNode(node)
        port = Port(asked, order, clock, memoryview(self._mail[order]).cast("B"), asked.ask)
        self._port_words[order, : confinement.TEC] = NEVER, clock.phase_ns, clock.drift_ppb, 0, asked.link, 0
        self._core[at.PORTS] += 1
        self._ports.append(port)
        self._set_filters()
        return port

    def detach(self, port: Port) -> None:
        """Cut a node off: it neither hears nor sends, and what it had queued is gone."""
        port.connected = False
        self._port_words[port.order, [at.WAKE, at.MAILED]] = NEVER, 0
        self._core[at.DUE] &= ~(1 << port.order)
        self.withdraw(port.order)
        self._set_filters()

    def reconnect(self, port: Port) -> None:
        """Put a node that was cut off back to its place; `start` powers it on."""
        port.connected = True
        self._set_filters()

    def unplug(self, port: Port) -> None:
        """Let a node go on without the bus: what it had queued is gone; the bench channel is left to it."""
        if port.plugged_in:
            port.plugged_in = False
            self.withdraw(port.order)
            self._set_filters()
            self.edit(port, self._unheard)

    def plug_in(self, port: Port) -> None:
        """Put a node that was unplugged back on the bus."""
        if not port.plugged_in:
            port.plugged_in = True
            self._set_filters()
            self.stop_editing(port, self._unheard)

    def edit(self, port: Port, edit: Edit) -> None:
        """Change from now on what a node answers, after what others have changed before."""
        port.edits.append(edit)
        self._set_way(port)

    def stop_editing(self, port: Port, edit: Edit) -> None:
        """Change it no more; may be asked for by the edit itself."""
        port.edits.remove(edit)
        self._set_way(port)

    def put_off(self, port: Port, late_ns: int) -> None:
        """Let the wake-up that a node waits for be late."""
        words = self._port_words[port.order]
        if words[at.WAKE] != NEVER:
            words[at.WAKE] += late_ns

    def set_drift(self, port: Port, drift_ppb: int) -> None:
        """Let a node's clock run fast from now on, by so many ns each s; it does not jump."""
        words, old = self._port_words[port.order], port.clock
        now_ns = old.local(self.now_ns)
        wake_ns = old.local(int(words[at.WAKE])) if words[at.WAKE] != NEVER else None
        drifting = Clock(0, drift_ppb)
        port.clock = new = replace(drifting, phase_ns=self.now_ns - drifting.bus(now_ns))
        words[[at.PHASE, at.DRIFT_PPB]] = new.phase_ns, new.drift_ppb
        if wake_ns is not None:
            words[at.WAKE] = max(new.bus(wake_ns), self.now_ns)

    def start(self, port: Port) -> None:
        """Power a node on now; it has seen no error."""
        words = self._mail[port.order]
        self._port_words[port.order, confinement.TEC :] = 0
        self._make_room()
        words[: at.FRAMES] = START, port.clock.local(self.now_ns)
        self._port_words[port.order, at.MAILED] = 0
        length = port.ask(port.packet[: at.FRAMES * 8], self._answer)
        self._go_on(length, port.order, self.now_ns)

    def send(self, sender: int, ready_ns: int, frame: Frame) -> None:
        """Hand a frame to a CAN controller at bus time `ready_ns`, now or later.

        Parameters
        ----------
        sender : int
            A port's order; a number from `wire_core.MAX_PORTS` on for a sender that is no node.
        """
        self._make_room()
        _hand_over(
            self._core,
            self._port_words,
            self._queue,
            self._faults,
            self._out_of_band,
            sender,
            ready_ns,
            *self._words(frame),
        )

    def withdraw(self, sender: int) -> None:
        """Forget what a sender has handed over and that has not begun."""
        queued = self._queue[: self._core[at.QUEUED]]
        kept = queued[queued[:, at.SENDER] != sender]
        self._queue[: len(kept)] = kept
        self._core[at.QUEUED] = len(kept)

    def waiting(self, sender: int) -> int:
        """Return the number of frames that a sender has handed over and that have not begun."""
        return int(np.count_nonzero(self._queue[: self._core[at.QUEUED], at.SENDER] == sender))

    def spoil(self, can_id: int, fault: FrameFault, argument: int, count: int) -> None:
        """Let something happen to the next `count` frames of an id that are handed over.

        Raises
        ------
        ValueError
            If too many faults are under way.
        """
        free = np.flatnonzero(self._faults[:, at.FAULT_COUNT] == 0)
        if not free.size:
            raise ValueError(f"there is room for {at.MAX_FAULTS} faults at a time")
        if fault == FrameFault.REPEAT:
            earlier = self.log[self.log[:, at.LOG_HEAD] & 0xFFFF_FFFF == can_id]
            argument = int(earlier[-1, at.LOG_DATA]) if len(earlier) else 0
        self._faults[free[0]] = can_id, fault, _signed(argument), count
        self._core[at.FAULTS] = max(self._core[at.FAULTS], free[0] + 1)

    def disturb(self, bit_error_rate: float, duration_ns: int, seed: int = 0) -> None:
        """Let every bit be bad with a probability, from now on; each bad one destroys the frame it is in.

        Parameters
        ----------
        bit_error_rate : float
            From 1e-9 to 0.5, in steps of 1e-9.
        duration_ns : int
            How long.
        seed : int
            Of the random numbers, 0 to 2**63 - 1.

        Raises
        ------
        ValueError
            If one of them is not as said.
        """
        if not 1e-9 <= bit_error_rate <= 0.5:
            raise ValueError(f"a bit error rate is from 1e-9 to 0.5, not {bit_error_rate}")
        if duration_ns <= 0:
            raise ValueError(f"noise takes time, not {duration_ns} ns")
        if not 0 <= seed < 1 << 63:
            raise ValueError(f"a seed is from 0 to 2**63 - 1, not {seed}")
        noise = self.now_ns + duration_ns, round(bit_error_rate * 1e9), seed
        self._core[[at.NOISE_UNTIL, at.NOISE_LEVEL, at.NOISE_STATE]] = noise

    def babble(self, frame: Frame, gap_ns: int, duration_ns: int) -> None:
        """Let a faulty sender that is no node send a frame again and again, from now on.

        It keeps the rules of arbitration, so the identifier says whom it holds up. Faults of `spoil` but
        `DESTROY` do not touch it.

        Parameters
        ----------
        frame : Frame
            What it sends.
        gap_ns : int
            From the end of one frame's intermission to the next frame; 0 leaves no room for lower priorities.
        duration_ns : int
            How long; a frame that is waiting or under way at the end is still sent.

        Raises
        ------
        ValueError
            If one of them is not as said, or the wire has a babbling sender already.
        """
        if gap_ns < 0:
            raise ValueError(f"a gap is 0 ns or more, not {gap_ns}")
        if duration_ns <= 0:
            raise ValueError(f"babbling takes time, not {duration_ns} ns")
        under_way = self._core[at.END] != NEVER and self._core[at.ON_WIRE_SENDER] == at.BABBLER
        if self.now_ns < self._core[at.BABBLE_UNTIL] or under_way or self.waiting(at.BABBLER):
            raise ValueError("one sender is babbling already: wait until it ends")
        self._core[[at.BABBLE_GAP, at.BABBLE_UNTIL]] = gap_ns, self.now_ns + duration_ns
        self._make_room()
        at.enqueue(self._core, self._queue, at.BABBLER, *self._words(frame))

    def force_bus_off(self, port: Port) -> None:
        """Take a node's CAN controller off the bus now, as 32 destroyed frames would.

        What the node had queued is gone; a frame of its under way still ends. It recovers after 128 sequences
        of 11 recessive bits from now, and until then neither hears nor sends.
        """
        at.let_recover(self._core, self._port_words)
        if not self._core[at.BUS_OFF]:  # else idle bits are counted already
            self._core[[at.BUS_OFF, at.COUNTED_UNTIL]] = True, self.now_ns
        words = self._port_words[port.order]
        words[[confinement.TEC, confinement.SEQUENCES_LEFT]] = (
            confinement.BUS_OFF_FROM,
            confinement.RECOVERY_SEQUENCES,
        )
        self.withdraw(port.order)

    def error_state(self, port: Port) -> ErrorState:
        """Return what fault confinement says of a node now."""
        at.let_recover(self._core, self._port_words)
        tec, rec, left, _ = self._port_words[port.order, confinement.TEC :].tolist()
        passive = max(tec, rec) >= confinement.PASSIVE_FROM
        return ErrorState("bus-off" if left else "error-passive" if passive else "error-active", tec, rec)

    def exchanges(self, port: Port) -> int:
        """Return how many events a node in another process was asked about."""
        return int(self._port_words[port.order, at.EXCHANGES])

    def next_event_ns(self) -> int:
        """Return the bus time of the next event, `NEVER` if there is none."""
        return int(at.next_event_ns(self._core, self._port_words, self._queue))

    def run(self, until_ns: int) -> None:
        """Process every event before bus time `until_ns`."""
        self._go_on(0, 0, until_ns)

    def discard(self, rows: int) -> None:
        """Forget the oldest rows of the log."""
        kept = self.log[rows:].copy()
        self._log[: len(kept)] = kept
        self._core[at.LOGGED] = len(kept)
        if self._payloads:
            self._discard_payloads()

    def _words(self, frame: Frame) -> tuple[int, int]:
        """Return a frame's head and data, its payload kept if it is a CAN FD one."""
        can_id, dlc, data = frame
        if not can_id & FD_FLAG:
            return can_id | dlc << 32, _signed(data)
        payload = payload_words(data)
        number, self._next_payload = self._next_payload, (self._next_payload + 1) % _PAYLOADS
        self._payloads[number] = payload
        head = can_id & 0xFFFF_FFFF | dlc << 32 | can_id >> 32 << at.FLAGS_SHIFT
        return head, fd_log_data(fd_bits(can_id, dlc, payload), number)

    def _discard_payloads(self) -> None:
        """Forget the payloads of frames that are in no log or queue and not on the wire."""
        queued = self._queue[: self._core[at.QUEUED], [at.HEAD, at.DATA]]
        on_wire = self._core[[at.ON_WIRE_HEAD, at.ON_WIRE_DATA]]
        there = np.vstack([self.log[:, [at.LOG_HEAD, at.LOG_DATA]], queued, on_wire])
        numbers = there[there[:, 0] >> at.FLAGS_SHIFT > 0, 1] >> PAYLOAD_SHIFT
        self._payloads = {number: self._payloads[number] for number in set(numbers.tolist())}

    def _go_on(self, length: int, order: int, until_ns: int) -> None:
        """Do what the node at a port has answered, then go on to `until_ns`."""
        places, answer = self._ports, self._answer
        advance = partial(self._advance, self._filters, self._queue, self._log)
        while True:
            due = advance(length, order, until_ns)
            if due >= 0:
                order = due & 0xFF
                port = places[order]
                length = port.ask(port.packet[: due >> 8], answer)
            elif due == at.NOBODY:
                return
            elif due == at.NO_ROOM:
                self._make_room()
                advance = partial(self._advance, self._filters, self._queue, self._log)
                length = 0
            else:
                order = at.NO_ANSWER - due
                length = places[order].node.late_answer(answer)

    def _make_room(self) -> None:
        """Double what may be full."""
        if self._core[at.LOGGED] == len(self._log):
            self._log = np.concatenate([self._log, np.zeros_like(self._log)])
        if self._core[at.QUEUED] + at.MAX_ANSWER_FRAMES > len(self._queue):
            self._queue = np.concatenate([self._queue, np.zeros_like(self._queue)])

    def _set_filters(self) -> None:
        rows = []
        for port in self._ports:
            node = port.node
            if port.connected:
                known = node.latched if node.accepts is None else node.accepts
                ids = [can_id for can_id in sorted(known) if port.plugged_in or can_id in self._out_of_band]
                rows += [(can_id, port.order, can_id in node.latched) for can_id in ids]
                rows += [(at.EVERY_ID, port.order, False)] if node.accepts is None and port.plugged_in else []
        self._filters = np.array(rows, np.int64).reshape(-1, at.FILTER_SIZE)
        self._core[at.FILTERS] = len(rows)

    def _set_way(self, port: Port) -> None:
        """Ask a node by way of its edits, if there are any."""
        linked = not port.edits and port.node.link != at.NO_LINK
        self._port_words[port.order, at.LINK] = port.node.link if linked else at.NO_LINK
        port.ask = partial(self._ask_and_edit, port) if port.edits else port.node.ask

    def _ask_and_edit(self, port: Port, packet: memoryview, answer: bytearray) -> int:
        self._port_words[port.order, at.EXCHANGES] += port.node.link != at.NO_LINK
        actions = unpack_actions(answer, port.node.ask(packet, answer))
        for edit in (*port.edits,):
            actions = edit(actions)
        return pack_actions_into(answer, actions)

    def _unheard(self, actions: Actions) -> Actions:
        """Take away what a node sends over the bus; the bench channel is none."""
        heard = tuple(send for send in actions.sends if send[1].can_id in self._out_of_band)
        return actions._replace(sends=heard)


def _id_and_dlc(head: Any) -> tuple[Any, Any]:
    """Return identifier with its flags, and length, of a head (`hil.bus.wire_core`) or an array of them."""
    return head & 0xFFFF_FFFF | head >> at.FLAGS_SHIFT << 32, head >> 32 & 0xFF


def _signed(word: int) -> int:
    """Return the two's complement value of a 64-bit word."""
    return word - (1 << 64) if word >> 63 == 1 else word
