"""The wire: a discrete-event simulation that owns time and decides who speaks when.

Time is integer nanoseconds. The next event is the earliest of a frame's end, a node's wake-up, the release of
a frame to its CAN controller, and arbitration; at the same instant they come in this order, and wake-ups in
the order in which the nodes were attached.
"""

from array import array
from dataclasses import dataclass, field
from heapq import heappop, heappush

from dbc.frame import EFF_FLAG, Frame
from dbc.jit import entry_point
from dbc.node import NOTHING, Actions, Node
from hil.bus.wire_time import classic_bits

NEVER = 1 << 62
INTERMISSION_BITS = 3
_frame_bits = entry_point(classic_bits)
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Clock:
    """A node's own clock: it starts `phase_ns` after bus time 0 and runs `drift_ppb` fast."""

    phase_ns: int = 0
    drift_ppb: int = 0

    def local(self, bus_ns: int) -> int:
        """Return the node's time at bus time `bus_ns`, ns."""
        elapsed_ns = bus_ns - self.phase_ns
        return elapsed_ns + (elapsed_ns * self.drift_ppb // _NS_PER_S if self.drift_ppb else 0)

    def bus(self, local_ns: int) -> int:
        """Return the first bus time at which the node's clock shows `local_ns` or later, ns."""
        if not self.drift_ppb:
            return self.phase_ns + local_ns
        return self.phase_ns - (-local_ns * _NS_PER_S // (_NS_PER_S + self.drift_ppb))


@dataclass(slots=True, eq=False)
class Port:
    """A node's place on the wire."""

    node: Node
    order: int
    clock: Clock
    connected: bool = True
    on_bus_time: bool = False


@dataclass(slots=True)
class Traffic:
    """Every frame that ended on the wire, in order: bus time of its end (ns), id, dlc, data."""

    cells: array = field(default_factory=lambda: array("Q"))

    def __len__(self) -> int:
        return len(self.cells) // 4


def arbitration_key(can_id: int) -> int:
    """Return the number by which identifiers win arbitration: the lower first.

    A standard frame beats an extended one with the same base identifier (ISO 11898-1).
    """
    if can_id & EFF_FLAG:
        base, extension = (can_id >> 18) & 0x7FF, can_id & 0x3FFFF
        return base << 19 | 1 << 18 | extension
    return can_id << 19


class Wire:
    """A classic CAN bus between nodes, without errors.

    Parameters
    ----------
    bit_rate : int
        Bit/s.
    out_of_band : frozenset of int
        Ids of the bench channel: delivered the moment they are sent, without using the bus.
    """

    def __init__(self, bit_rate: int, out_of_band: frozenset[int] = frozenset()) -> None:
        self.bit_rate = bit_rate
        self.now_ns = 0
        self.traffic = Traffic()
        self.busy_ns = 0
        self._out_of_band = out_of_band
        self._ports: list[Port] = []
        self._wakes: list[int] = []
        self._routes: dict[int, list[Port]] = {}
        self._keys: dict[int, int] = {}
        self._released: list[tuple[int, int, Port, Frame]] = []
        self._pending: list[tuple[int, int, int, int, Port, Frame]] = []
        self._sequence = 0
        self._on_wire: tuple[Port, Frame] | None = None
        self._end_ns = NEVER
        self._idle_ns = 0

    def attach(self, node: Node, clock: Clock | None = None) -> Port:
        """Add a node; it hears nothing of what was already under way.

        Raises
        ------
        ValueError
            If a node of that name is there already.
        """
        if any(port.connected and port.node.name == node.name for port in self._ports):
            raise ValueError(f"there is a node named {node.name!r} on this bus already")
        clock = clock or Clock()
        port = Port(node, len(self._ports), clock, on_bus_time=clock == Clock())
        self._ports.append(port)
        self._wakes.append(NEVER)
        self._routes.clear()
        return port

    def detach(self, port: Port) -> None:
        """Cut a node off: it neither hears nor sends, and what it had queued is gone."""
        port.connected = False
        self._wakes[port.order] = NEVER
        self._routes.clear()
        self._released[:] = sorted(entry for entry in self._released if entry[2] is not port)
        self._pending[:] = sorted(entry for entry in self._pending if entry[4] is not port)

    def start(self, port: Port) -> None:
        """Power a node on now."""
        self._apply(port, port.node.on_start(port.clock.local(self.now_ns)))

    def send(self, port: Port, ready_ns: int, frame: Frame) -> None:
        """Hand a frame to the port's CAN controller at bus time `ready_ns`, now or later."""
        self._sequence += 1
        now_ns = self.now_ns
        if ready_ns > now_ns or frame.can_id in self._out_of_band:
            heappush(self._released, (max(ready_ns, now_ns), self._sequence, port, frame))
        else:
            self._queue(now_ns, self._sequence, port, frame)

    def waiting(self, port: Port) -> int:
        """Return the number of frames that a port has handed over and that have not started."""
        return sum(entry[4] is port for entry in self._pending) + sum(
            entry[2] is port for entry in self._released
        )

    def next_event_ns(self) -> int:
        """Return the bus time of the next event, `NEVER` if there is none."""
        arbitration_ns = max(self._idle_ns, self.now_ns) if self._pending and self._on_wire is None else NEVER
        release_ns = self._released[0][0] if self._released else NEVER
        return min(self._end_ns, min(self._wakes, default=NEVER), release_ns, arbitration_ns)

    def run(self, until_ns: int) -> None:
        """Process every event before bus time `until_ns`."""
        wakes, released, pending = self._wakes or [NEVER], self._released, self._pending
        while True:
            end_ns, wake_ns = self._end_ns, min(wakes)
            event_ns = end_ns if end_ns <= wake_ns else wake_ns
            release_ns = released[0][0] if released else NEVER
            if release_ns < event_ns:
                event_ns = release_ns
            arbitration_ns = NEVER
            if pending and end_ns == NEVER:
                arbitration_ns = self._idle_ns if self._idle_ns > self.now_ns else self.now_ns
                if arbitration_ns < event_ns:
                    event_ns = arbitration_ns
            if event_ns >= until_ns:
                break
            self.now_ns = event_ns
            if event_ns == end_ns:
                self._finish_frame()
            elif event_ns == wake_ns:
                self._wake()
            elif event_ns == release_ns:
                self._release()
            else:
                self._arbitrate()
        self.now_ns = max(self.now_ns, until_ns)

    def _wake(self) -> None:
        now_ns = self.now_ns
        order = self._wakes.index(now_ns)
        port = self._ports[order]
        self._wakes[order] = NEVER
        local_ns = now_ns if port.on_bus_time else port.clock.local(now_ns)
        self._apply(port, port.node.on_timer(local_ns))

    def _apply(self, port: Port, actions: Actions) -> None:
        wake_ns, sends = actions
        on_bus_time, to_bus = port.on_bus_time, port.clock.bus
        if wake_ns is not None:
            wake_ns = wake_ns if on_bus_time else to_bus(wake_ns)
            self._wakes[port.order] = wake_ns if wake_ns > self.now_ns else self.now_ns
        for send_ns, frame in sends:
            self.send(port, send_ns if on_bus_time else to_bus(send_ns), frame)

    def _release(self) -> None:
        ready_ns, sequence, port, frame = heappop(self._released)
        if frame.can_id in self._out_of_band:
            self._deliver(port, frame)
        else:
            self._queue(ready_ns, sequence, port, frame)

    def _queue(self, ready_ns: int, sequence: int, port: Port, frame: Frame) -> None:
        can_id = frame.can_id
        key = self._keys.get(can_id)
        if key is None:
            key = self._keys[can_id] = arbitration_key(can_id)
        heappush(self._pending, (key, port.order, ready_ns, sequence, port, frame))

    def _arbitrate(self) -> None:
        *_, port, frame = heappop(self._pending)
        bits = _frame_bits(*frame)
        start_ns = self.now_ns
        self._on_wire = port, frame
        self._end_ns = start_ns + (bits - INTERMISSION_BITS) * _NS_PER_S // self.bit_rate
        self._idle_ns = start_ns + bits * _NS_PER_S // self.bit_rate
        self.busy_ns += self._idle_ns - start_ns

    def _finish_frame(self) -> None:
        assert self._on_wire is not None
        port, frame = self._on_wire
        self._on_wire = None
        self._end_ns = NEVER
        self._deliver(port, frame)

    def _deliver(self, sender: Port, frame: Frame) -> None:
        now_ns = self.now_ns
        self.traffic.cells.extend((now_ns, *frame))
        for port in self._routes.get(frame.can_id) or self._route(frame.can_id):
            if port is not sender:
                local_ns = now_ns if port.on_bus_time else port.clock.local(now_ns)
                actions = port.node.on_frame(local_ns, frame)
                if actions is not NOTHING:
                    self._apply(port, actions)

    def _route(self, can_id: int) -> list[Port]:
        route = self._routes[can_id] = [
            port
            for port in self._ports
            if port.connected and (port.node.accepts is None or can_id in port.node.accepts)
        ]
        return route
