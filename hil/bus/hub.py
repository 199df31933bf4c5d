"""The hub: lets other processes onto the wire, as nodes in virtual time or as ordinary bus participants."""

import os
import select
import selectors
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from dbc.frame import Frame
from dbc.node import NOTHING, Actions
from hil.bus import link
from hil.bus.link import LinkError
from hil.bus.wire import NEVER, Clock, Port, Wire

QUEUE_FRAMES = 100_000
"""Frames a slow listener may lag behind before further ones are dropped, and counted."""

_MAX_MAIL_BYTES = 32768
_IDLE_POLL_S = 0.2
_LAST_FLUSH_S = 2.0
_FRAMES_PER_SERVICE = 64
"""Frames taken from one participant at a time; one that sends faster than the bus carries is made to wait."""


class NodeGoneError(Exception):
    """A node process ended, or did not answer in time."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"the {name} process {reason}")
        self.name = name
        self.silent = reason.startswith("did not answer")


class RemoteNode:
    """A node whose code runs in another process, one exchange per entry point.

    Frames it only latches wait here and travel with its next wake-up.
    """

    def __init__(self, connection: socket.socket, hello: dict[str, Any], answer_timeout_s: float) -> None:
        self.name: str = hello["name"]
        self.accepts = None if hello["accepts"] is None else frozenset(hello["accepts"])
        self.latched = frozenset(hello["latched"])
        self.transmits = frozenset(hello["transmits"])
        self.exchanges = 0
        self._timeout_s = answer_timeout_s
        self._link = connection
        self._mail = b""
        connection.setblocking(True)
        timeout = struct.pack("ll", int(answer_timeout_s), int(answer_timeout_s % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on or reset."""
        return self._exchange(link.START, now_ns)

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt."""
        return self._exchange(link.TIMER, now_ns)

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt."""
        self._mail += link.pack_timed(now_ns, frame)
        if frame.can_id in self.latched and len(self._mail) < _MAX_MAIL_BYTES:
            return NOTHING
        return self._exchange(link.FRAME, now_ns)

    def stop(self) -> None:
        """Tell the process to write its record and end."""
        with suppress(OSError):  # it may have ended by itself
            self._link.send(link.pack_event(link.STOP, 0))
        self._link.close()

    def _exchange(self, kind: int, now_ns: int) -> Actions:
        try:
            self._link.send(link.pack_event(kind, now_ns, self._mail))
            answer = self._link.recv(link.MAX_PACKET)
        except BlockingIOError:
            raise NodeGoneError(self.name, f"did not answer for {self._timeout_s:g} s") from None
        except OSError:
            answer = b""
        if not answer:
            raise NodeGoneError(self.name, "ended")
        self._mail = b""
        self.exchanges += 1
        return link.unpack_actions(answer)


class Participant:
    """A python-can program on the bus: hears everything, never makes the wire wait."""

    accepts = None
    latched: frozenset[int] = frozenset()
    transmits: frozenset[int] = frozenset()

    def __init__(self, connection: socket.socket, name: str) -> None:
        self.name = name
        self.dropped = 0
        self._link = connection
        self._queue: deque[bytes] = deque()
        connection.setblocking(False)

    def on_start(self, now_ns: int) -> Actions:
        """Have nothing to say at power-on."""
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Have no timer."""
        return NOTHING

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Pass a frame on, or queue it while the program is slow."""
        if len(self._queue) >= QUEUE_FRAMES:
            self.dropped += 1
        else:
            self._queue.append(link.pack_timed(now_ns, frame))
        self.flush()
        return NOTHING

    @property
    def behind(self) -> int:
        """Frames that wait for the program."""
        return len(self._queue)

    def flush(self) -> None:
        """Send what the program has room for."""
        try:
            while self._queue:
                self._link.send(self._queue[0])
                self._queue.popleft()
        except BlockingIOError:
            pass
        except OSError:
            self._queue.clear()  # it has gone: service() will see the end of the link


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
    """

    def __init__(
        self, wire: Wire, channel: str, expected: frozenset[str] | None, answer_timeout_s: float = 10.0
    ) -> None:
        self.wire = wire
        self.channel = channel
        self.nodes: dict[str, RemoteNode] = {}
        self.injections: list[tuple[int, Frame]] = []
        self._dropped_by_gone = 0
        self._expected = expected
        self._virtual = expected is not None
        self._answer_timeout_s = answer_timeout_s
        self._participants: dict[int, tuple[Port, Participant, socket.socket]] = {}
        self._strangers: dict[int, socket.socket] = {}
        self._names = 0
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
        return self._dropped_by_gone + sum(entry[1].dropped for entry in self._participants.values())

    def close(self) -> None:
        """End all nodes and participants and remove the socket; idempotent."""
        for node in self.nodes.values():
            node.stop()
        deadline_s = time.monotonic() + _LAST_FLUSH_S
        for _, participant, connection in self._participants.values():
            while participant.behind and time.monotonic() < deadline_s:
                select.select([], [connection], [], _LAST_FLUSH_S)
                participant.flush()
            self._dropped_by_gone += participant.dropped + participant.behind
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

    def service(self, timeout_s: float = 0.0) -> None:
        """Greet who arrives, take what participants send, and pass on what they could not take before."""
        ready = self._selector.select(timeout_s)
        self._catch_up()
        for key, _ in ready:
            if key.fileobj is self._listener:
                self._accept()
            elif key.fd in self._strangers:
                self._greet(self._strangers.pop(key.fd))
            else:
                self._take(key.fd)
        for _, participant, _ in self._participants.values():
            participant.flush()

    def run_in_wall_time(
        self, keep_running: Callable[[], bool], clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Serve while `keep_running` says so, with bus time running as `clock_ns` does."""
        origin_ns = clock_ns()
        self._catch_up = lambda: self.wire.run(clock_ns() - origin_ns)
        while keep_running():
            self._catch_up()
            next_ns = self.wire.next_event_ns()
            wait_s = _IDLE_POLL_S if next_ns >= NEVER else (next_ns - self.wire.now_ns) / 1e9
            self.service(min(max(wait_s, 0.0), _IDLE_POLL_S))

    def attach(self, name: str, clock: Clock | None = None) -> Port:
        """Put a node that has said hello onto the wire."""
        return self.wire.attach(self.nodes[name], clock)

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
            error = self._refusal(hello)
            if error:
                link.send_json(connection, {"error": error})
                connection.close()
                return
            link.send_json(connection, {"virtual": self._virtual, "bit_rate": self.wire.bit_rate})
        except (LinkError, OSError):
            connection.close()
            return
        if self._virtual and hello["role"] == "node":
            self.nodes[hello["name"]] = RemoteNode(connection, hello, self._answer_timeout_s)
            return
        self._names += 1
        is_node = hello["role"] == "node"
        participant = Participant(connection, hello["name"] if is_node else f"(participant {self._names})")
        port = self.wire.attach(participant)
        self._participants[connection.fileno()] = port, participant, connection
        self._selector.register(connection, selectors.EVENT_READ)

    def _refusal(self, hello: dict[str, Any]) -> str | None:
        if hello.get("version") != link.PROTOCOL_VERSION:
            return f"the hub speaks protocol {link.PROTOCOL_VERSION}: use the same release on both sides"
        if not _is_complete(hello):
            return "the greeting is incomplete: use the same release on both sides"
        name = hello["name"] if hello["role"] == "node" else None
        taken = set(self.nodes) | {entry[1].name for entry in self._participants.values()}
        if self._expected is not None and name is not None and name not in self._expected:
            return f"this run has no place for a node named {name!r}"
        if name is not None and name.startswith("("):
            return f"a node cannot be named {name!r}"
        if name in taken:
            return f"channel {self.channel!r} has a {name} already: stop it or choose another channel"
        return None

    def _take(self, fd: int) -> None:
        port, participant, connection = self._participants[fd]
        try:
            for _ in range(_FRAMES_PER_SERVICE - self.wire.waiting(port)):
                packet = connection.recv(link.MAX_PACKET)
                if not packet:
                    if self.wire.waiting(port):
                        return  # it has gone, but what it sent is still to go onto the wire
                    break
                frame = link.unpack_frame(packet)
                if self._virtual:
                    self.injections.append((self.wire.now_ns, frame))
                self.wire.send(port, self.wire.now_ns, frame)
            else:
                return
        except (BlockingIOError, ConnectionResetError):
            return  # reset: it has gone without reading all; what it sent before is still to be taken
        except (OSError, ValueError):
            pass  # it has gone, or sends what is no frame: cut it off
        self._selector.unregister(connection)
        self._dropped_by_gone += participant.dropped
        self.wire.detach(port)
        del self._participants[fd]
        connection.close()


def _is_complete(hello: dict[str, Any]) -> bool:
    """Tell whether a greeting has all that its role needs."""
    if hello.get("role") == "bus":
        return True
    accepts = hello.get("accepts", ())
    ids = [hello.get("latched"), hello.get("transmits"), [] if accepts is None else accepts]
    return (
        hello.get("role") == "node"
        and isinstance(hello.get("name"), str)
        and all(isinstance(group, list) and all(isinstance(i, int) for i in group) for group in ids)
    )
