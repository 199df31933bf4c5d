"""What has to be done to a wire at times that are to come."""

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

from hil.bus.wire import NEVER, Wire


class Agenda:
    """Actions by bus time.

    Parameters
    ----------
    wire : Wire
        The bus whose time counts.
    failed : callable
        Told the ValueError of what was put off and by now cannot be done; by default it is raised.
    """

    def __init__(self, wire: Wire, failed: Callable[[ValueError], None] | None = None) -> None:
        self._wire = wire
        self._failed = failed or _raise
        self._entries: list[tuple[int, int, Callable[[], None]]] = []
        self._ever = count()

    @property
    def next_ns(self) -> int:
        """Bus time of the next action, `NEVER` if there is none."""
        return self._entries[0][0] if self._entries else NEVER

    def at(self, bus_ns: int, action: Callable[[], None]) -> None:
        """Have something done at a bus time, before the wire's events at that time; at once if it is now."""
        if bus_ns <= self._wire.now_ns:
            action()
        else:
            heappush(self._entries, (bus_ns, next(self._ever), action))

    def run(self, until_ns: int) -> None:
        """Let the wire process every event before bus time `until_ns`, and do what is due before."""
        while self._entries and self._entries[0][0] < until_ns:
            bus_ns, _, action = heappop(self._entries)
            self._wire.run(bus_ns)
            try:
                action()
            except ValueError as error:
                self._failed(error)
        self._wire.run(until_ns)


def _raise(error: ValueError) -> None:
    raise error
