"""The hub: lets other processes onto the wire, as nodes in virtual time or as ordinary bus participants."""

import itertools
import os
import select
import selectors
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from dbc.frame import Frame
from dbc.packet import pack_event
from hil.bus import link
from hil.bus.agenda import Agenda
from hil.bus.link import LinkError
from hil.bus.wire import NEVER, Clock, Port, Wire
from hil.bus.wire_core import FLAGS_SHIFT, LOG_HEAD, LOG_SENDER, MAX_PORTS

QUEUE_FRAMES = 100_000
"""Frames a slow listener may lag behind before further ones are dropped, and counted."""

_DISCARD_ROWS = 4096
_IDLE_POLL_S = 0.2
_LAST_FLUSH_S = 2.0
_ONE_ANSWER = ("fault", "faults")
"""Roles of those who ask, are answered, and leave."""

_TOLD_FAULTS = 200
"""The newest, which one packet has room for."""

_FRAMES_PER_SERVICE = 64
"""Frames taken from one participant at a time; one that sends faster than the bus carries is made to wait."""


class NodeGoneError(Exception):
    """A node process ended, or did not answer in time."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"the {name} process {reason}")
        self.name = name
        self.silent = reason.startswith("did not answer")


class RemoteNode:
    """A node whose code runs in another process, one exchange for each event."""

    def __init__(self, connection: socket.socket, hello: dict[str, Any], answer_timeout_s: float) -> None:
        self.name: str = hello["name"]
        self.accepts = None if hello["accepts"] is None else frozenset(hello["accepts"])
        self.latched = frozenset(hello["latched"])
        self.link = connection.fileno()
        self._timeout_s = answer_timeout_s
        self._link = connection
        connection.setblocking(True)
        timeout = struct.pack("ll", int(answer_timeout_s), int(answer_timeout_s % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)

    def ask(self, packet: memoryview | bytes, answer: bytearray) -> int:
        """Put the process's answer to an event into `answer`; return its length in bytes.

        Raises
        ------
        NodeGoneError
            If it has ended or does not answer in time.
        """
        with suppress(OSError):  # then there will be no answer
            self._link.send(packet)
        return self.late_answer(answer)

    def late_answer(self, answer: bytearray) -> int:
        """Wait for the answer to a packet that was sent, and return it like `ask`."""
        try:
            length = self._link.recv_into(answer)
        except BlockingIOError:
            raise NodeGoneError(self.name, f"did not answer for {self._timeout_s:g} s") from None
        except OSError:
            length = 0
        if not length:
            raise NodeGoneError(self.name, "ended")
        return length

    def save(self) -> None:
        """Let the process write its record now."""
        self.ask(pack_event(link.SAVE), bytearray(link.MAX_PACKET))

    def forget(self) -> None:
        """Let the process begin its record anew."""
        self.ask(pack_event(link.FORGET), bytearray(link.MAX_PACKET))

    def stop(self) -> None:
        """Tell the process to write its record and end."""
        with suppress(OSError):  # it may have ended by itself
            self._link.send(pack_event(link.STOP))
        self._link.close()


class Participant:
    """A python-can program on the bus: it reads the wire's log at its own pace.

    Attributes
    ----------
    name : str
        Unique on the channel.
    sender : int
        Its number as a sender on the wire.
    position : int
        Row of the log that it gets next.
    dropped : int
        Frames it did not get because it was too slow.
    """

    def __init__(self, connection: socket.socket, name: str, sender: int, position: int, fd: bool) -> None:
        self.name = name
        self.sender = sender
        self.position = position
        self.dropped = 0
        self._fd = fd
        self._link = connection
        connection.setblocking(False)

    def flush(self, wire: Wire) -> None:
        """Send what the program has room for of what others sent; drop the oldest of too much."""
        log = wire.log
        self._skip_to(log, len(log) - QUEUE_FRAMES)
        rows = log[self.position :]
        if not len(rows):
            return
        packets, send = rows.data.cast("B"), self._link.send
        try:
            for at, sender, fd in zip(
                range(0, len(packets), rows.strides[0]),
                rows[:, LOG_SENDER].tolist(),
                (rows[:, LOG_HEAD] >> FLAGS_SHIFT).tolist(),
                strict=True,
            ):
                if sender != self.sender:
                    if not fd:
                        send(packets[at : at + link.TIMED_FRAME_BYTES])
                    elif self._fd:
                        send(link.pack_timed(*wire.logged(self.position)))
                self.position += 1
        except BlockingIOError:
            pass
        except OSError:  # it has gone: service() will see the end of the link
            self.position = len(log)

    def give_up(self, log: np.ndarray) -> None:
        """Drop all that the program has not taken."""
        self._skip_to(log, len(log))

    def _skip_to(self, log: np.ndarray, position: int) -> None:
        if position > self.position:
            lost = log[self.position : position]
            of_its_kind = self._fd | (lost[:, LOG_HEAD] >> FLAGS_SHIFT == 0)
            self.dropped += int(np.count_nonzero(of_its_kind & (lost[:, LOG_SENDER] != self.sender)))
            self.position = position


class Hub:
    """A channel that processes attach to, and what they send to the wire.

    Parameters
    ----------
    wire : Wire
        The bus the channel leads to.
    channel : str
        Name of the channel.
    expected : frozenset of str or None
        Names of the nodes that are asked event by event, in virtual time; None for wall time, in which all
        are plain participants.
    answer_timeout_s : float
        How long a node may take to answer an event, s of wall time.

    Raises
    ------
    LinkError
        If another hub serves the channel.

    Attributes
    ----------
    take_fault : callable
        Has a fault, as a table, that somebody asks for; raises ValueError with the reason if it cannot.
    taken : list of dict
        Faults that it had, as tables, each with its ``bus_time_s``.
    agenda : Agenda
        What is to be done to the wire, in wall time.
    """

    def __init__(
        self, wire: Wire, channel: str, expected: frozenset[str] | None, answer_timeout_s: float = 10.0
    ) -> None:
        self.wire = wire
        self.channel = channel
        self.nodes: dict[str, RemoteNode] = {}
        self.injections: list[tuple[int, Frame]] = []
        self.take_fault: Callable[[dict[str, Any]], None] = _take_no_fault
        self.taken: list[dict[str, Any]] = []
        self.agenda = Agenda(wire)
        self._dropped_by_gone = 0
        self._expected = expected
        self._virtual = expected is not None
        self._answer_timeout_s = answer_timeout_s
        self._participants: dict[int, tuple[Participant, socket.socket]] = {}
        self._strangers: dict[int, socket.socket] = {}
        self._held: set[int] = set()
        self._senders = itertools.count(MAX_PORTS)
        self._own_sender = next(self._senders)
        self._catch_up: Callable[[], None] = lambda: None
        self._selector = selectors.SelectSelector()
        self._path = link.socket_path(channel)
        self._listener = link.seqpacket_socket()
        try:
            self._bind()
        except BaseException:
            self._listener.close()
            raise
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)

    def __enter__(self) -> "Hub":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def dropped(self) -> int:
        """Frames that slow listeners lost."""
        return self._dropped_by_gone + sum(who.dropped for who, _ in self._participants.values())

    def close(self) -> None:
        """End all nodes and participants and remove the socket; idempotent."""
        for node in self.nodes.values():
            node.stop()
        self._flush_to_the_end()
        self._dropped_by_gone = self.dropped
        for _, connection in self._participants.values():
            connection.close()
        for connection in self._strangers.values():
            connection.close()
        self.nodes.clear()
        self._participants.clear()
        self._strangers.clear()
        if self._listener.fileno() >= 0:
            self._selector.close()
            self._listener.close()
            self._path.unlink(missing_ok=True)

    def lead_to(self, wire: Wire) -> None:
        """Go on with another wire, whose bus time begins anew; who listens has heard all of the last one."""
        self._flush_to_the_end()
        for participant, _ in self._participants.values():
            participant.position = 0
        self.wire = wire
        self.injections = []

    def service(self, timeout_s: float = 0.0) -> None:
        """Greet who arrives, take what participants send, and pass on what they have not got yet."""
        self._release_held()
        ready = self._selector.select(timeout_s)
        self._catch_up()
        for key, _ in ready:
            if key.fileobj is self._listener:
                self._accept()
            elif key.fd in self._strangers:
                self._greet(self._strangers.pop(key.fd))
            else:
                self._take(key.fd)
        self._pass_on()

    def run_in_wall_time(
        self, keep_running: Callable[[], bool], clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Serve while `keep_running` says so, with bus time running as `clock_ns` does."""
        origin_ns = clock_ns()
        self._catch_up = lambda: self.agenda.run(clock_ns() - origin_ns)
        while keep_running():
            self._catch_up()
            self._pass_on()  # now: nothing else may happen for long
            next_ns = min(self.wire.next_event_ns(), self.agenda.next_ns)
            wait_s = _IDLE_POLL_S if next_ns >= NEVER else (next_ns - self.wire.now_ns) / 1e9
            self.service(min(max(wait_s, 0.0), _IDLE_POLL_S))
            self._discard_what_all_have_read()

    def send(self, frame: Frame) -> None:
        """Send a frame of the hub's own."""
        self.wire.send(self._own_sender, self.wire.now_ns, frame)

    def attach(self, name: str, clock: Clock | None = None) -> Port:
        """Put a node that has said hello onto the wire."""
        return self.wire.attach(self.nodes[name], clock)

    def _pass_on(self) -> None:
        for participant, _ in self._participants.values():
            participant.flush(self.wire)

    def _flush_to_the_end(self) -> None:
        """Give listeners some time to take the rest; what they do not take is dropped."""
        log = self.wire.log
        deadline_s = time.monotonic() + _LAST_FLUSH_S
        for participant, connection in self._participants.values():
            participant.flush(self.wire)
            while participant.position < len(log) and time.monotonic() < deadline_s:
                select.select([], [connection], [], _LAST_FLUSH_S)
                participant.flush(self.wire)
            participant.give_up(log)

    def _discard_what_all_have_read(self) -> None:
        log = self.wire.log
        if len(log) < _DISCARD_ROWS:
            return
        read = min((who.position for who, _ in self._participants.values()), default=len(log))
        if read >= _DISCARD_ROWS:
            self.wire.discard(read)
            for participant, _ in self._participants.values():
                participant.position -= read

    def _release_held(self) -> None:
        """Listen again to senders whose frames have found their way onto the bus."""
        for fd in list(self._held):
            participant, connection = self._participants[fd]
            if self.wire.waiting(participant.sender) < _FRAMES_PER_SERVICE:
                self._held.remove(fd)
                self._selector.register(connection, selectors.EVENT_READ)

    def _bind(self) -> None:
        for _ in range(2):
            try:
                self._listener.bind(os.fspath(self._path))
                self._listener.listen(16)
                return
            except OSError:
                self._remove_stale_socket()
        raise LinkError(f"cannot serve channel {self.channel!r} at {self._path}")

    def _remove_stale_socket(self) -> None:
        probe = link.seqpacket_socket()
        try:
            probe.connect(os.fspath(self._path))
        except OSError:
            self._path.unlink(missing_ok=True)
        else:
            raise LinkError(f"channel {self.channel!r} has a hub already: choose another --channel")
        finally:
            probe.close()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        self._strangers[connection.fileno()] = connection
        self._selector.register(connection, selectors.EVENT_READ)

    def _greet(self, connection: socket.socket) -> None:
        self._selector.unregister(connection)
        try:
            hello = link.receive_json(connection)
            answer = self._answer_to(hello)
            link.send_json(connection, answer)
        except (LinkError, OSError):
            connection.close()
            return
        if "error" in answer or hello["role"] in _ONE_ANSWER:
            connection.close()
            return
        if self._virtual and hello["role"] == "node":
            self.nodes[hello["name"]] = RemoteNode(connection, hello, self._answer_timeout_s)
            return
        sender = next(self._senders)
        name = hello["name"] if hello["role"] == "node" else f"(participant {sender})"
        participant = Participant(connection, name, sender, len(self.wire.log), bool(hello.get("fd")))
        self._participants[connection.fileno()] = participant, connection
        self._selector.register(connection, selectors.EVENT_READ)

    def _answer_to(self, hello: dict[str, Any]) -> dict[str, Any]:
        if error := self._refusal(hello):
            return {"error": error}
        bus_time_s = self.wire.now_ns / 1e9
        if hello["role"] == "faults":
            return {"faults": self.taken[-_TOLD_FAULTS:]}
        if hello["role"] == "fault":
            try:
                self.take_fault(hello["fault"])
            except ValueError as error:
                return {"error": str(error)}
            self.taken.append(hello["fault"] | {"bus_time_s": bus_time_s})
        return {
            "virtual": self._virtual,
            "bit_rate": self.wire.bit_rate,
            "data_bit_rate": self.wire.data_bit_rate,
            "bus_time_s": bus_time_s,
        }

    def _refusal(self, hello: dict[str, Any]) -> str | None:
        if hello.get("version") != link.PROTOCOL_VERSION:
            return f"the hub speaks protocol {link.PROTOCOL_VERSION}: use the same release on both sides"
        if not _is_complete(hello):
            return "the greeting is incomplete: use the same release on both sides"
        name = hello["name"] if hello["role"] == "node" else None
        taken = set(self.nodes) | {who.name for who, _ in self._participants.values()}
        if self._expected is not None and name is not None and name not in self._expected:
            return f"this run has no place for a node named {name!r}"
        if name is not None and name.startswith("("):
            return f"a node cannot be named {name!r}"
        if name in taken:
            return f"channel {self.channel!r} has a {name} already: stop it or choose another channel"
        return None

    def _take(self, fd: int) -> None:
        participant, connection = self._participants[fd]
        wire = self.wire
        try:
            for _ in range(_FRAMES_PER_SERVICE - wire.waiting(participant.sender)):
                packet = connection.recv(link.MAX_PACKET)
                if not packet:
                    break
                frame = link.unpack_frame(packet)
                if self._virtual:
                    self.injections.append((wire.now_ns, frame))
                wire.send(participant.sender, wire.now_ns, frame)
            else:
                self._held.add(fd)
                self._selector.unregister(connection)
                return
        except (BlockingIOError, ConnectionResetError):
            return  # reset: it has gone without reading all; what it sent before is still to be taken
        except (OSError, ValueError):
            pass  # it has gone, or sends what is no frame: cut it off
        self._selector.unregister(connection)
        self._dropped_by_gone += participant.dropped
        del self._participants[fd]
        connection.close()


def _take_no_fault(table: dict[str, Any]) -> None:
    raise ValueError("nothing runs on this channel yet: inject faults when it does")


def _is_complete(hello: dict[str, Any]) -> bool:
    """Tell whether a greeting has all that its role needs."""
    if hello.get("role") in ("bus", "faults"):
        return True
    if hello.get("role") == "fault":
        return isinstance(hello.get("fault"), dict)
    accepts = hello.get("accepts", ())
    ids = [hello.get("latched"), hello.get("transmits"), [] if accepts is None else accepts]
    return (
        hello.get("role") == "node"
        and isinstance(hello.get("name"), str)
        and all(isinstance(group, list) and all(isinstance(i, int) for i in group) for group in ids)
    )
