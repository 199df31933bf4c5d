"""Faults of sensor and machine on a bus where no supervisor of ours sends them."""

from collections.abc import Callable
from functools import partial

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.node import PERIOD_NS


class BenchSender:
    """Turns what a supervisor would be told into frames of the bench channel.

    It knows of no other load than its own: what it sends takes the place of what acted before.

    Parameters
    ----------
    contract : Contract
        The DBC.
    at : callable
        Has something done at a time, ns.
    send : callable
        Sends a frame now.
    """

    def __init__(
        self,
        contract: Contract,
        at: Callable[[int, Callable[[], None]], None],
        send: Callable[[Frame], None],
    ) -> None:
        self._control, self._load = contract.bench_control, contract.bench_load
        self._at, self._send = at, send
        self._load_n = 0

    def plan(
        self, period: int, *, control: tuple[int, int, int] | None = None, add_load_n: int | None = None
    ) -> None:
        """Send what makes the change in a period; see `hil.supervisor.Supervisor.plan`."""
        if control is not None:
            frame = self._control.frame(self._control.pack(*control))
            self._at(period * PERIOD_NS, partial(self._send, frame))
        if add_load_n is not None:
            self._at(period * PERIOD_NS, partial(self._add_load, add_load_n))

    def _add_load(self, force_n: int) -> None:
        self._load_n += force_n
        self._send(self._load.frame(self._load.pack(self._load_n)))
