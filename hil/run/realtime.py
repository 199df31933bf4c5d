"""One node on a real bus, against the wall clock.

All processes of one machine take node time from `CLOCK_MONOTONIC` times the real-time ratio, so that their
periods are aligned as a SYNC message would align them on separate machines.
"""

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from heapq import heappop, heappush

import can
import numpy as np

from dbc.frame import Frame
from dbc.node import PERIOD_NS, Actions, Node
from hil.bus.messages import to_frame, to_message
from hil.bus.wire import NEVER, Clock

_LISTEN_PERIODS = 30
_MAX_WAIT_S = 0.05


class DuplicateNodeError(Exception):
    """Another sender of this node's frames is on the bus already."""


@dataclass(slots=True)
class Lateness:
    """How late the node's timer ran, in node time.

    Attributes
    ----------
    timer_ns : array
        Lateness of each timer call, ns.
    overruns : int
        Whole control periods that passed without a timer call.
    """

    timer_ns: array = field(default_factory=lambda: array("q"))
    overruns: int = 0

    def summary(self) -> dict[str, float]:
        """Return the median, 99th percentile and maximum in µs, and the overruns."""
        late = np.array(self.timer_ns) if self.timer_ns else np.zeros(1)
        p50, p99 = np.percentile(late, [50, 99])
        return {
            "p50_us": p50 / 1e3,
            "p99_us": p99 / 1e3,
            "max_us": late.max() / 1e3,
            "overruns": self.overruns,
        }


class RealtimeNode:
    """Runs one node on one python-can bus.

    Parameters
    ----------
    node : Node
        The node.
    bus : can.BusABC
        Where its frames go.
    ratio : Fraction
        Node time per wall time; 1/10 runs ten times slower than real.
    clock : Clock
        The node's phase and drift against the shared time base.
    """

    def __init__(self, node: Node, bus: can.BusABC, ratio: Fraction, clock: Clock) -> None:
        self.lateness = Lateness()
        self._node = node
        self._bus = bus
        self._ratio = ratio
        self._clock = clock
        self._wake_ns = NEVER
        self._sends: list[tuple[int, int, Frame]] = []
        self._sequence = 0

    def listen_for_duplicate(self) -> None:
        """Listen for some periods before the first frame.

        Raises
        ------
        DuplicateNodeError
            If somebody else sends this node's frames.
        """
        until_ns = self._now() + _LISTEN_PERIODS * PERIOD_NS
        while (wait_ns := until_ns - self._now()) > 0:
            message = self._bus.recv(self._wall_s(wait_ns))
            if message is not None and self._is_ours(message):
                raise DuplicateNodeError(
                    f"{self._bus.channel_info} has a {self._node.name} already: "
                    "stop it or choose another channel"
                )

    def run(self, keep_running: Callable[[], bool]) -> None:
        """Run until `keep_running` returns False; it is asked before every wait."""
        self._apply(self._node.on_start(self._now()))
        while keep_running():
            self._send_due()
            now_ns = self._now()
            if now_ns >= self._wake_ns:
                self._on_timer(now_ns)
                continue
            due_ns = min(self._wake_ns, self._sends[0][0] if self._sends else NEVER)
            message = self._bus.recv(min(max(self._wall_s(due_ns - now_ns), 0.0), _MAX_WAIT_S))
            if message is not None:
                self._receive(message)

    def _now(self) -> int:
        return self._clock.local(time.monotonic_ns() * self._ratio.numerator // self._ratio.denominator)

    def _wall_s(self, node_ns: int) -> float:
        return node_ns * self._ratio.denominator / self._ratio.numerator / 1e9

    def _on_timer(self, now_ns: int) -> None:
        late_ns = now_ns - self._wake_ns
        self.lateness.timer_ns.append(late_ns)
        self.lateness.overruns += late_ns // PERIOD_NS
        self._wake_ns = NEVER
        self._apply(self._node.on_timer(now_ns))

    def _receive(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_remote_frame or message.is_fd:
            return
        frame = to_frame(message)
        if self._node.accepts is None or frame.can_id in self._node.accepts:
            self._apply(self._node.on_frame(self._now(), frame))

    def _is_ours(self, message: can.Message) -> bool:
        if message.is_error_frame or message.is_remote_frame or message.is_fd:
            return False
        return to_frame(message).can_id in self._node.transmits

    def _apply(self, actions: Actions) -> None:
        wake_ns, sends = actions
        if wake_ns is not None:
            self._wake_ns = wake_ns
        for send_ns, frame in sends:
            self._sequence += 1
            heappush(self._sends, (send_ns, self._sequence, frame))

    def _send_due(self) -> None:
        while self._sends and self._sends[0][0] <= self._now():
            _, _, frame = heappop(self._sends)
            self._bus.send(to_message(0, frame))
