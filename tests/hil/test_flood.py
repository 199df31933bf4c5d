"""A million frames: listeners change nothing, and no frame is lost without being counted."""

import hashlib
import subprocess
import sys

from bench_runs import wait_until

from dbc.frame import Frame
from dbc.node import NOTHING, Actions
from hil.bus.hub import Hub
from hil.bus.wire import Wire

FRAMES = 1_000_000
BURST = 50
NO_NODES: frozenset[str] = frozenset()

LISTENER = """
import sys
from hil.bus import link
connection, _ = link.connect("flood", {"role": "bus"})
print("attached", flush=True)
count, disorder, newest = 0, 0, -1
while packet := connection.recv(100):
    count += 1
    number = int.from_bytes(packet[16:24], "little")
    disorder += number <= newest
    newest = number
print(count, disorder)
"""


class Flood:
    """Keeps the bus full: short frames that carry their number."""

    name, accepts, latched, transmits = "flood", frozenset(), frozenset(), frozenset({0x100})

    def __init__(self) -> None:
        self._next = 0

    def on_start(self, now_ns: int) -> Actions:
        return Actions(now_ns)

    def on_timer(self, now_ns: int) -> Actions:
        numbers = range(self._next, min(self._next + BURST, FRAMES))
        self._next += len(numbers)
        if not numbers:
            return NOTHING
        frames = tuple((now_ns, Frame(0x100, 3, number)) for number in numbers)
        return Actions(now_ns + BURST * 100_000, frames)  # a frame takes 80 to 90 µs

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        return NOTHING


def flood(hub: Hub | None, wire: Wire) -> str:
    """Let a million frames pass and return the traffic's hash."""
    wire.start(wire.attach(Flood()))
    while len(wire.log) < FRAMES:
        wire.run(wire.now_ns + 50_000_000)
        if hub is not None:
            hub.service()
    return hashlib.sha256(wire.traffic.tobytes()).hexdigest()


def test_listeners_change_nothing_and_no_frame_of_a_million_is_lost_without_being_counted():
    alone = flood(None, Wire(1_000_000))
    wire = Wire(1_000_000)
    with Hub(wire, "flood", expected=NO_NODES) as hub:
        command = [sys.executable, "-c", LISTENER]
        with (
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as eager,
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as asleep,
        ):
            wait_until(lambda: hub.service(0.01) or len(hub._participants) == 2, "two listeners attach")
            assert eager.stdout is not None
            assert asleep.stdout is not None
            eager.stdout.readline()
            asleep.stdout.readline()
            subprocess.run(["kill", "-STOP", str(asleep.pid)], check=True)
            assert flood(hub, wire) == alone
            subprocess.run(["kill", "-CONT", str(asleep.pid)], check=True)
            hub.close()
            heard = [tuple(map(int, listener.stdout.read().split())) for listener in (eager, asleep)]
    assert [disorder for _, disorder in heard] == [0, 0]
    assert sum(count for count, _ in heard) + hub.dropped == 2 * FRAMES
    assert heard[1][0] < FRAMES
