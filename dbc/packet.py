"""Events and their answers as packets of 64-bit words, which is how a wire asks its nodes.

An event is its kind and the node's time (ns), then three words for each frame that comes with it: its time
(ns), its head (identifier, length << 32) and its data. An answer is when the node wants to wake (ns), or
`NO_WAKE`, then send time, head and data of each frame it sends. An empty answer changes nothing.
"""

import struct
from collections.abc import Callable
from functools import partial

from numba.extending import register_jitable

from dbc.frame import Frame
from dbc.node import NOTHING, Actions, Node

START, TIMER, FRAME = range(3)
"""Kinds of event."""

NO_WAKE = -(1 << 63)

KIND, TIME, FRAMES = range(3)
"""Words of an event; the frames come from the last of them on."""

FRAME_WORDS = 3
ID_MASK, HEAD_DLC = 0xFFFF_FFFF, 32
"""Of a frame's head: where the identifier lies, and the bit at which the length begins."""

NOT_ANSWERED = -1
"""What compiled code returns of an event that it leaves to the node's entry points."""

TIMED_FRAME = struct.Struct("<qIB3xQ")
"""A frame in SocketCAN's layout behind its time (ns)."""

_EVENT = struct.Struct("<qq")
_WAKE = struct.Struct("<q")
_WAKE_AND_FRAME = struct.Struct("<qqIB3xQ")

Answer = Callable[[memoryview, bytearray], int]
"""Puts the answer to an event into a buffer and returns its length in bytes."""


@register_jitable
def put_frame(answer, number, send_ns, head, data):  # type: ignore[no-untyped-def]
    """Put frame `number` (0, 1, ...) into an answer, an int64 array; return the answer's length in bytes."""
    word = 1 + number * FRAME_WORDS
    answer[word], answer[word + 1], answer[word + 2] = send_ns, head, data
    return 8 * (word + FRAME_WORDS)


def answers_of(node: Node) -> Answer:
    """Return what answers events for a node: its own method ``answer`` if it has one, else its entry points.

    A node has such a method for speed: it must do what its entry points do.
    """
    own: Answer = getattr(node, "answer", partial(answer_by_entry_points, node))
    return own


def answer_by_entry_points(node: Node, packet: memoryview, answer: bytearray) -> int:
    """Call a node's entry points for an event and the frames that come with it; answer with its actions."""
    kind, now_ns = _EVENT.unpack_from(packet)
    actions = NOTHING
    if len(packet) > _EVENT.size:
        new, on_frame = tuple.__new__, node.on_frame  # new: a third of the cost of Frame(...)
        for time_ns, *frame in TIMED_FRAME.iter_unpack(packet[_EVENT.size :]):
            actions = on_frame(time_ns, new(Frame, frame))
    if kind == TIMER:
        actions = node.on_timer(now_ns)
    elif kind == START:
        actions = node.on_start(now_ns)
    return 0 if actions is NOTHING else pack_actions_into(answer, actions)


def pack_event(kind: int, now_ns: int = 0) -> bytes:
    """Return an event without frames."""
    return _EVENT.pack(kind, now_ns)


def event_ns(packet: memoryview) -> int:
    """Return the node's time at an event, ns."""
    now_ns: int = _EVENT.unpack_from(packet)[TIME]
    return now_ns


def pack_actions_into(answer: bytearray, actions: Actions) -> int:
    """Put a node's actions into `answer`; return its length in bytes."""
    wake_ns, sends = actions
    if wake_ns is None:
        wake_ns = NO_WAKE
    if len(sends) == 1:  # by far the most frequent
        send_ns, frame = sends[0]
        _WAKE_AND_FRAME.pack_into(answer, 0, wake_ns, send_ns, *frame)
        return _WAKE_AND_FRAME.size
    _WAKE.pack_into(answer, 0, wake_ns)
    length = _WAKE.size
    for send_ns, frame in sends:
        length = append_frame(answer, length, send_ns, frame)
    return length


def unpack_actions(answer: bytearray, length: int) -> Actions:
    """Return the actions in an answer of `length` bytes."""
    if not length:
        return NOTHING
    (wake_ns,) = _WAKE.unpack_from(answer)
    frames = TIMED_FRAME.iter_unpack(memoryview(answer)[_WAKE.size : length])
    sends = tuple((send_ns, Frame(*frame)) for send_ns, *frame in frames)
    return Actions(None if wake_ns == NO_WAKE else wake_ns, sends)


def append_frame(answer: bytearray, length: int, send_ns: int, frame: Frame) -> int:
    """Put one more frame into an answer of `length` bytes; return what it comes to."""
    TIMED_FRAME.pack_into(answer, length, send_ns, *frame)
    return length + TIMED_FRAME.size
