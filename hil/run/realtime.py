"""One node on a real bus, against the wall clock.

All processes of one machine take node time from `CLOCK_MONOTONIC` (`shared_ns`), so that their periods are
aligned as a SYNC message would align them on separate machines. Deadlines are absolute: nothing
that is late once makes what follows late. The engine sleeps on the bus until `SPIN_NS` before a deadline and
polls clock and bus from there on; it never polls for longer, as under SCHED_FIFO nothing else would run.
"""

import os
import select
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from heapq import heappop, heappush, heappushpop
from typing import Any

import can
import numpy as np

from dbc.frame import Frame
from dbc.node import PERIOD_NS, Actions, Node
from hil.bus.messages import to_frame, to_message
from hil.bus.wire import NEVER, Clock

SPIN_NS = 200_000
"""How long before a deadline polling begins, ns of wall time: longer than most sleeps are late."""

LAST_LOOK_NS = 5_000
"""How long before a deadline the bus is looked at last, ns of wall time: a look takes 1 to 2 µs."""

FIFO_PRIORITY = 10
"""Of 1 to 99: above every ordinary process, below the kernel's own interrupt threads (50)."""

TICK_MARGIN_NS = 200_000
"""Where the shared time begins, ns of CLOCK_MONOTONIC.

Linux' timer tick falls on whole ms and takes up to 60 µs on a virtual machine: no period should begin there.
"""

SWITCH_INTERVAL_S = 1e-4
"""How long another Python thread may compute while this one is due; CPython's own is 5 ms."""

CATCH_UP_FRAMES = 16
"""What a bus at 1 Mbit/s carries in two periods."""

_KEPT_STALLS = 20
_LISTEN_PERIODS = 30
_MAX_WAIT_NS = 40_000_000


class DuplicateNodeError(Exception):
    """Another sender of this node's frames is on the bus already."""


def shared_ns(monotonic_ns: int, ratio: Fraction) -> int:
    """Return the time that all nodes of this machine share, ns of node time."""
    numerator, denominator = ratio.as_integer_ratio()
    return (monotonic_ns - TICK_MARGIN_NS) * numerator // denominator


@dataclass(slots=True)
class Lateness:
    """How late the node's timer ran.

    Lateness is wall time, whatever the real-time ratio: it tells of the machine. Overruns are of the node's
    periods, which are longer in wall time when the ratio is below 1.

    Attributes
    ----------
    timer_ns : array
        Lateness of each timer call, ns of wall time.
    overruns : int
        Whole control periods that passed without a timer call.
    stalls : int
        Timer calls that were late by a period or more.
    scheduler : str
        "fifo" if the last run had SCHED_FIFO, else "other".
    """

    timer_ns: array = field(default_factory=lambda: array("q"))
    overruns: int = 0
    stalls: int = 0
    scheduler: str = "other"
    _longest: list[tuple[int, int]] = field(default_factory=list)

    @property
    def longest_stalls(self) -> list[tuple[int, int]]:
        """The longest stalls, in order of time: node time at which the timer was due, wall time late, ns."""
        return sorted((due_ns, late_ns) for late_ns, due_ns in self._longest)

    def note(self, due_ns: int, late_ns: int, missed: int) -> None:
        """Take down a timer call: node time due, wall time late (ns), and whole periods missed."""
        self.timer_ns.append(late_ns)
        if missed:
            self.overruns += missed
            self.stalls += 1
            keep = heappush if len(self._longest) < _KEPT_STALLS else heappushpop
            keep(self._longest, (late_ns, due_ns))

    def summary(self) -> dict[str, Any]:
        """Return percentiles and maximum in µs of wall time, overruns, stalls and scheduler."""
        late_us = np.array(self.timer_ns if self.timer_ns else [0]) / 1e3
        p50, p99, p999 = (float(p) for p in np.percentile(late_us, [50, 99, 99.9]))
        return {
            "p50_us": p50,
            "p99_us": p99,
            "p999_us": p999,
            "max_us": float(late_us.max()),
            "overruns": self.overruns,
            "stalls": self.stalls,
            "longest_stalls_ns": self.longest_stalls,
            "scheduler": self.scheduler,
        }


@contextmanager
def fifo_scheduling() -> Iterator[str]:
    """Put the calling thread under SCHED_FIFO for a while, where that is permitted.

    It needs root, CAP_SYS_NICE or a limit `rtprio` of at least `FIFO_PRIORITY`. A thread that is under it
    already keeps its priority.

    Yields
    ------
    str
        "fifo", or "other" if it is not to be had.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield "other"
        return
    try:
        before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
        if before != os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except OSError:
        yield "other"
        return
    try:
        yield "fifo"
    finally:
        os.sched_setscheduler(0, before, parameter)


@contextmanager
def short_switch_interval() -> Iterator[None]:
    """Let no other thread of this process keep the interpreter for long, for a while."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(min(before_s, SWITCH_INTERVAL_S))
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)


class RealtimeNode:
    """Runs one node on one python-can bus.

    Frames are delivered as they come, sends leave at their time, and the timer is called at its deadline:
    after every frame the deadline is checked, so that a flood of frames delays it by one frame at most.
    Where nobody could look at the bus shortly before the deadline (a stall, an entry point that took long),
    up to `CATCH_UP_FRAMES` waiting frames are delivered before the timer call, as the receive interrupts of
    a controller would have been.

    **Overruns.** A timer that is late by whole periods is called once, with the true time. The periods it
    missed are counted and not made up for: if the node asks for a time that has passed, it gets the next one
    that is whole periods later. Periods that pass between two calls of `run` are skipped without count.

    May be run in a thread of its own; what a node or the bus raises comes out of `run`.

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
    monotonic_ns : callable, optional
        The wall clock, ns.
    """

    def __init__(
        self,
        node: Node,
        bus: can.BusABC,
        ratio: Fraction,
        clock: Clock,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.lateness = Lateness()
        self._node = node
        self._bus = bus
        self._poll = _poll_of(bus)
        self._has_more = True
        self._ratio = ratio
        self._clock = clock
        self._monotonic_ns = monotonic_ns
        self._looked_ns = 0
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
            message = self._bus.recv(self._wall_span(wait_ns) / 1e9)
            if message is not None and self._is_ours(message):
                raise DuplicateNodeError(
                    f"{self._bus.channel_info} has a {self._node.name} already: "
                    "stop it or choose another channel"
                )

    def start(self) -> None:
        """Power the node on; what it asks for happens in `run`."""
        self._apply(self._node.on_start(self._now()))

    def run(self, keep_running: Callable[[], bool]) -> None:
        """Run until `keep_running` returns False, which is asked before every wait, of 40 ms at most.

        May be called again, to go on with the same node.
        """
        self._wake_ns = _upcoming(self._wake_ns, self._now())
        with short_switch_interval(), fifo_scheduling() as self.lateness.scheduler:
            while keep_running():
                due_ns = min(self._wake_ns, self._sends[0][0] if self._sends else NEVER)
                message = self._wait(self._wall(due_ns))
                if message is not None:
                    self._receive(message)
                self._act()

    def _now(self) -> int:
        return self._local(self._monotonic_ns())

    def _local(self, wall_ns: int) -> int:
        return self._clock.local(shared_ns(wall_ns, self._ratio))

    def _wall(self, local_ns: int) -> int:
        """Return the first wall time at which the node's clock shows `local_ns` or later, ns."""
        return TICK_MARGIN_NS + self._wall_span(self._clock.bus(local_ns))

    def _wall_span(self, node_ns: int) -> int:
        return -(-node_ns * self._ratio.denominator // self._ratio.numerator)

    def _wait(self, due_ns: int) -> can.Message | None:
        """Return the next message, or None at wall time `due_ns` or after the longest wait."""
        monotonic_ns = self._monotonic_ns
        now_ns = monotonic_ns()
        spin_from_ns = due_ns - SPIN_NS
        if now_ns < spin_from_ns:
            self._looked_ns = now_ns
            message = self._recv(min(spin_from_ns - now_ns, _MAX_WAIT_NS) / 1e9)
            if message is not None:
                return message
            now_ns = monotonic_ns()
        while spin_from_ns <= now_ns < due_ns:
            if now_ns < due_ns - LAST_LOOK_NS:
                self._looked_ns = now_ns
                message = self._look()
                if message is not None:
                    return message
            now_ns = monotonic_ns()
        return None

    def _look(self) -> can.Message | None:
        """Return a message that is there already, if any.

        After a message the descriptor is not believed: some interfaces take more from it than they give.
        """
        if self._poll is not None and not self._has_more and not self._poll(0):
            return None
        return self._recv(0)

    def _recv(self, timeout_s: float) -> can.Message | None:
        message = self._bus.recv(timeout_s)
        self._has_more = message is not None
        return message

    def _act(self) -> None:
        """Send what is due before the timer, then call the timer if it is due."""
        wall_ns = self._monotonic_ns()
        now_ns = self._local(wall_ns)
        while self._sends and self._sends[0][0] <= now_ns and self._sends[0][0] < self._wake_ns:
            _, _, frame = heappop(self._sends)
            self._bus.send(to_message(0, frame))
        if self._wake_ns <= now_ns and wall_ns - self._looked_ns > SPIN_NS:
            self._catch_up()
            now_ns = self._now()
        if self._wake_ns <= now_ns:
            self._call_timer(now_ns)

    def _catch_up(self) -> None:
        self._looked_ns = self._monotonic_ns()
        for _ in range(CATCH_UP_FRAMES):
            message = self._look()
            if message is None:
                return
            self._receive(message)

    def _call_timer(self, now_ns: int) -> None:
        due_ns, self._wake_ns = self._wake_ns, NEVER
        late_ns = now_ns - due_ns
        actions = self._node.on_timer(now_ns)
        self.lateness.note(due_ns, self._wall_span(late_ns), late_ns // PERIOD_NS)
        self._apply(actions)
        self._wake_ns = _upcoming(self._wake_ns, now_ns)

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


def _poll_of(bus: can.BusABC) -> Callable[[int], list[tuple[int, int]]] | None:
    """Return a cheap way to ask whether there is something to receive, None where there is none."""
    try:
        descriptor = bus.fileno()
    except NotImplementedError:
        return None
    if descriptor < 0 or not hasattr(select, "poll"):
        return None
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return poll.poll


def _upcoming(wake_ns: int, now_ns: int) -> int:
    """Return the wake-up, if its time has passed the first one after now that is whole periods later."""
    return wake_ns if wake_ns > now_ns else wake_ns + ((now_ns - wake_ns) // PERIOD_NS + 1) * PERIOD_NS
