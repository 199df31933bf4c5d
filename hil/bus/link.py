"""Packets between a hub and its participants, over AF_UNIX SEQPACKET sockets in a private directory.

Frames keep SocketCAN's 16-byte layout. A participant says hello in JSON and is answered in JSON; after that

- a *bus* participant (any python-can program) sends frames and receives frames with their bus time;
- a *node* in virtual time receives one event at a time and answers each with its actions.
"""

import json
import os
import socket
import stat
import struct
import tempfile
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from dbc.frame import EFF_FLAG, Frame
from dbc.node import NOTHING, Actions, Node

PROTOCOL_VERSION = 2
MAX_PACKET = 65536
START, TIMER, FRAME, STOP, SAVE, FORGET = range(6)
NO_WAKE = -(1 << 63)

_FRAME = struct.Struct("<IB3xQ")
_TIMED_FRAME = struct.Struct("<qIB3xQ")
TIMED_FRAME_BYTES = _TIMED_FRAME.size
_EVENT = struct.Struct("<qq")
_WAKE = struct.Struct("<q")
_WAKE_AND_FRAME = struct.Struct("<qqIB3xQ")


class LinkError(Exception):
    """A hub cannot be reached, refused us, or went away; the message says what to do."""


def pack_frame(frame: Frame) -> bytes:
    """Return a frame as SocketCAN's `struct can_frame`."""
    return _FRAME.pack(*frame)


def unpack_frame(packet: bytes) -> Frame:
    """Return the frame in a `struct can_frame`.

    Raises
    ------
    ValueError
        If it is not a classic data frame.
    """
    if len(packet) != _FRAME.size:
        raise ValueError(f"{len(packet)} bytes are no classic frame")
    can_id, dlc, data = _FRAME.unpack(packet)
    highest = EFF_FLAG | 0x1FFF_FFFF if can_id & EFF_FLAG else 0x7FF
    if dlc > 8 or can_id > highest:
        raise ValueError(f"id {can_id:#x} with {dlc} bytes is no classic data frame")
    return Frame(can_id, dlc, data & ((1 << 8 * dlc) - 1))


def pack_timed(time_ns: int, frame: Frame) -> bytes:
    """Return a frame behind its bus time in ns."""
    return _TIMED_FRAME.pack(time_ns, *frame)


def unpack_timed(packet: bytes) -> tuple[int, Frame]:
    """Return bus time in ns and frame."""
    time_ns, can_id, dlc, data = _TIMED_FRAME.unpack(packet)
    return time_ns, Frame(can_id, dlc, data)


@runtime_checkable
class Askable(Protocol):
    """What the wire asks: a node, behind packets.

    Attributes
    ----------
    link : int
        Descriptor over which the wire may exchange packets itself; `wire_core.NO_LINK` without one.
    """

    name: str
    accepts: frozenset[int] | None
    latched: frozenset[int]
    link: int

    def ask(self, packet: memoryview, answer: bytearray) -> int:
        """Put the answer to an event into `answer`; return its length in bytes, 0 if nothing is wanted."""

    def late_answer(self, answer: bytearray) -> int:
        """Wait for the answer to a packet that the wire has sent itself, and return it like `ask`."""


def pack_event(kind: int, now_ns: int = 0) -> bytes:
    """Return an event without frames."""
    return _EVENT.pack(kind, now_ns)


def deliver(node: Node, packet: memoryview) -> Actions:
    """Call a node's entry points for an event and the frames that come with it; return its actions.

    The packet is kind and node time (ns), then the frames, each behind its own time.
    """
    kind, now_ns = _EVENT.unpack_from(packet)
    actions = NOTHING
    if len(packet) > _EVENT.size:
        new, on_frame = tuple.__new__, node.on_frame  # new: a third of the cost of Frame(...)
        for time_ns, *frame in _TIMED_FRAME.iter_unpack(packet[_EVENT.size :]):
            actions = on_frame(time_ns, new(Frame, frame))
    if kind == TIMER:
        return node.on_timer(now_ns)
    if kind == START:
        return node.on_start(now_ns)
    return actions


def pack_actions_into(answer: bytearray, actions: Actions) -> int:
    """Put a node's answer to an event into `answer`; return its length in bytes.

    It is when the node wants to wake, or `NO_WAKE`, then the frames, each behind its send time.
    """
    wake_ns, sends = actions
    if wake_ns is None:
        wake_ns = NO_WAKE
    if len(sends) == 1:  # by far the most frequent
        send_ns, frame = sends[0]
        _WAKE_AND_FRAME.pack_into(answer, 0, wake_ns, send_ns, *frame)
        return _WAKE_AND_FRAME.size
    _WAKE.pack_into(answer, 0, wake_ns)
    at = _WAKE.size
    for send_ns, frame in sends:
        _TIMED_FRAME.pack_into(answer, at, send_ns, *frame)
        at += _TIMED_FRAME.size
    return at


def unpack_actions(answer: bytearray, length: int) -> Actions:
    """Return the actions that `pack_actions_into` has put into the first bytes of `answer`."""
    if not length:
        return NOTHING
    (wake_ns,) = _WAKE.unpack_from(answer)
    frames = _TIMED_FRAME.iter_unpack(memoryview(answer)[_WAKE.size : length])
    sends = tuple((send_ns, Frame(*frame)) for send_ns, *frame in frames)
    return Actions(None if wake_ns == NO_WAKE else wake_ns, sends)


def socket_directory() -> Path:
    """Return the directory of this user's hub sockets, made with mode 0700.

    Raises
    ------
    LinkError
        If it belongs to somebody else or is open to others.
    """
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    directory = Path(base) / f"hilbus-{os.getuid()}"
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise LinkError(f"cannot make {directory} ({error.strerror}): set XDG_RUNTIME_DIR") from error
    status = directory.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise LinkError(f"{directory} is not a private directory of yours: remove it or set XDG_RUNTIME_DIR")
    return directory


def socket_path(channel: str) -> Path:
    """Return the socket of a channel.

    Raises
    ------
    LinkError
        If the name cannot be a file name.
    """
    if not channel or not all(c.isalnum() or c in "-_." for c in channel) or channel.startswith("."):
        raise LinkError(f"channel name {channel!r}: use letters, digits, '-', '_' and '.'")
    path = socket_directory() / f"{channel}.sock"
    if len(os.fsencode(path)) > 100:
        raise LinkError(f"{path} is too long for a socket: choose a shorter channel name or XDG_RUNTIME_DIR")
    return path


def seqpacket_socket() -> socket.socket:
    """Return a new AF_UNIX SEQPACKET socket.

    Raises
    ------
    LinkError
        On a system that has none (macOS, Windows).
    """
    try:
        return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    except (AttributeError, OSError) as error:
        raise LinkError(
            f"the embedded bus needs AF_UNIX SEQPACKET sockets ({error}): use Linux, or --mode inprocess"
        ) from error


def send_json(link: socket.socket, content: dict[str, Any]) -> None:
    """Send one hello or its answer."""
    link.send(json.dumps(content).encode())


def receive_json(link: socket.socket) -> dict[str, Any]:
    """Receive one hello or its answer.

    Raises
    ------
    LinkError
        If the other side went away or speaks something else.
    """
    try:
        packet = link.recv(MAX_PACKET)
        content = json.loads(packet) if packet else None
    except (OSError, ValueError) as error:
        raise LinkError(f"no answer in the hub's protocol ({error})") from error
    if not isinstance(content, dict):
        raise LinkError("the other side closed the link during the greeting")
    return content


def connect(
    channel: str, hello: dict[str, Any], timeout_s: float = 5.0
) -> tuple[socket.socket, dict[str, Any]]:
    """Attach to a hub and return the link and the hub's answer.

    Raises
    ------
    LinkError
        If there is no such hub, or it refuses.
    """
    path = socket_path(channel)
    link = seqpacket_socket()
    link.settimeout(timeout_s)
    try:
        link.connect(os.fspath(path))
    except OSError as error:
        link.close()
        raise LinkError(
            f"no hub on hilbus channel {channel!r}: start one with `hil bus --channel {channel}`"
        ) from error
    try:
        send_json(link, {"version": PROTOCOL_VERSION, **hello})
        answer = receive_json(link)
    except (LinkError, OSError) as error:
        link.close()
        raise LinkError(f"the hub on channel {channel!r} does not answer: {error}") from error
    if "error" in answer:
        link.close()
        raise LinkError(answer["error"])
    link.settimeout(None)
    return link, answer
