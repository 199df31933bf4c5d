"""Packets between a hub and its participants, over AF_UNIX SEQPACKET sockets in a private directory.

Frames keep SocketCAN's layout of 16 bytes, CAN FD frames that of 72. A participant says hello in JSON and is
answered in JSON; after that

- a *bus* participant (any python-can program) sends frames and receives frames with their bus time, those of
  CAN FD if it said so;
- a *node* in virtual time receives one event at a time and answers each (`dbc.packet`).
"""

import json
import os
import socket
import stat
import struct
import tempfile
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from can.util import CAN_FD_DLC

from dbc.frame import EFF_FLAG, FD_FLAG, Frame
from dbc.packet import TIMED_FRAME

PROTOCOL_VERSION = 3
MAX_PACKET = 65536
STOP, SAVE, FORGET = range(3, 6)
"""What a node is told beside events: to write its record and end, to write it, to begin it anew."""

_FRAME = struct.Struct("<IB3xQ")
_FD_FRAME = struct.Struct("<IBB2x64s")
_TIME = struct.Struct("<q")
TIMED_FRAME_BYTES = TIMED_FRAME.size


class LinkError(Exception):
    """A hub cannot be reached, refused us, or went away; the message says what to do."""


def pack_frame(frame: Frame) -> bytes:
    """Return a frame as SocketCAN's `struct can_frame`, or a CAN FD one as its `struct canfd_frame`."""
    can_id, dlc, data = frame
    if can_id & FD_FLAG:
        return _FD_FRAME.pack(can_id & 0xFFFF_FFFF, dlc, can_id >> 32, data.to_bytes(64, "little"))
    return _FRAME.pack(*frame)


def _read_fd_frame(packet: bytes) -> Frame:
    can_id, dlc, flags, data = _FD_FRAME.unpack(packet)
    return Frame(can_id | flags << 32 | FD_FLAG, dlc, int.from_bytes(data, "little"))


def unpack_frame(packet: bytes) -> Frame:
    """Return the frame in a `struct can_frame` or `struct canfd_frame`.

    Raises
    ------
    ValueError
        If it is not a data frame.
    """
    if len(packet) == _FRAME.size:
        can_id, dlc, data = _FRAME.unpack(packet)
        word, known = can_id, dlc <= 8
    elif len(packet) == _FD_FRAME.size:
        can_id, dlc, data = _read_fd_frame(packet)
        word, known = can_id & 0xFFFF_FFFF, dlc in CAN_FD_DLC and can_id < FD_FLAG << 1
    else:
        raise ValueError(f"{len(packet)} bytes are no frame")
    highest = EFF_FLAG | 0x1FFF_FFFF if word & EFF_FLAG else 0x7FF
    if not known or word > highest:
        raise ValueError(f"id {word:#x} with {dlc} bytes is no data frame")
    return Frame(can_id, dlc, data & ((1 << 8 * dlc) - 1))


def pack_timed(time_ns: int, frame: Frame) -> bytes:
    """Return a frame behind its bus time in ns."""
    return _TIME.pack(time_ns) + pack_frame(frame)


def unpack_timed(packet: bytes) -> tuple[int, Frame]:
    """Return bus time in ns and frame."""
    if len(packet) == TIMED_FRAME_BYTES:
        time_ns, can_id, dlc, data = TIMED_FRAME.unpack(packet)
        return time_ns, Frame(can_id, dlc, data)
    (time_ns,) = _TIME.unpack_from(packet)
    return time_ns, _read_fd_frame(packet[_TIME.size :])


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
