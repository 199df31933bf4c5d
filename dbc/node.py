"""What a node is: an object that is told the time and returns what it wants to send."""

from typing import NamedTuple, Protocol

from dbc.frame import Frame

PERIOD_NS = 1_000_000
"""Control period that all nodes share, ns."""


class Actions(NamedTuple):
    """What a node wants after an entry point returned; times in ns of the node's own clock.

    Attributes
    ----------
    wake_ns : int or None
        When `Node.on_timer` is to be called next; None leaves the timer as it is (off after it fired).
    sends : tuple of (int, Frame)
        Frames with the time at which each is handed to the CAN controller (not before now).
    """

    wake_ns: int | None = None
    sends: tuple[tuple[int, Frame], ...] = ()


NOTHING = Actions()


class Node(Protocol):
    """A participant that knows nothing of clocks, sockets or processes (sans-IO)."""

    @property
    def name(self) -> str:
        """Unique on a bus."""

    @property
    def accepts(self) -> frozenset[int] | None:
        """Acceptance filter over `Frame.can_id`; None accepts every frame."""

    @property
    def latched(self) -> frozenset[int]:
        """Accepted ids whose `on_frame` only stores the frame and returns `NOTHING`.

        In lock-step they travel with the next wake-up.
        """

    @property
    def transmits(self) -> frozenset[int]:
        """Ids this node is the only sender of."""

    def on_start(self, now_ns: int) -> Actions:
        """Power-on or reset."""

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt."""

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt."""


def next_period(now_ns: int) -> int:
    """Return the first multiple of the control period at or after `now_ns`, ns."""
    return -(-now_ns // PERIOD_NS) * PERIOD_NS
