"""What a bench consists of in every mode: a rig that stays, and one session on it after another."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol, Self

from dbc.contract import Contract
from hil.bus.wire import Port, Wire
from hil.run.options import Recording, RunOptions
from hil.scenario import PERIOD_S
from hil.supervisor import BRING_UP_PERIODS, Supervisor

PROGRESS_PERIODS = 100


class Session(Protocol):
    """One run, from power-on of all nodes on.

    Attributes
    ----------
    supervisor : Supervisor
        Steers the run.
    ending : str
        What ended it early; empty while all is well.
    """

    supervisor: Supervisor
    ending: str

    @property
    def wire(self) -> Wire | None:
        """The bus; None in real time."""

    @property
    def ports(self) -> Mapping[str, Port]:
        """The nodes' places on the wire; empty in real time."""

    def run_to(self, period: int) -> None:
        """Go on to the start of a period, counted from power-on, or until something ends the run."""

    def recording(self) -> Recording:
        """Return what there is so far."""

    def end(self) -> None:
        """Leave the machine disabled; idempotent."""


class Rig(Protocol):
    """Bus and nodes; a context manager, at whose end all that it started has ended.

    Attributes
    ----------
    mode : str
        "inprocess", "lockstep" or "realtime".
    contract : Contract
        The DBC.
    """

    mode: str
    contract: Contract

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    @property
    def bit_rate(self) -> int:
        """Bit/s."""

    @property
    def broken(self) -> bool:
        """Whether a process was lost, so that no further session can begin."""

    def begin(self, controller: str, position_m: float, bit_rate: int | None = None) -> Session:
        """Reset all nodes and begin a run with the machine at rest at `position_m`.

        Raises
        ------
        BenchError
            If the bus has another bit rate than is asked for.
        """

    def finish(self) -> str:
        """End the node processes that were started; return what went wrong with them, or nothing."""


def play(rig: Rig, options: RunOptions) -> Recording:
    """Play a scenario on a rig that is not used afterwards."""
    scenario = options.scenario
    session = rig.begin(options.controller, scenario.initial_m)
    session.supervisor.plan_scenario(scenario)
    end = BRING_UP_PERIODS + scenario.periods
    for period in (*range(PROGRESS_PERIODS, end, PROGRESS_PERIODS), end):
        session.run_to(period)
        if session.ending:
            break
        options.progress(period * PERIOD_S)
    session.end()
    failure = rig.finish()
    recording = session.recording()
    if failure and not recording.ending:
        return replace(recording, ending=failure, broken=True)
    return recording


class RigKeeper:
    """Keeps a rig open for as long as its context lasts, and replaces one that is broken.

    Parameters
    ----------
    new_rig : callable
        Returns a rig that has not been entered.
    """

    def __init__(self, new_rig: Callable[[], Rig]) -> None:
        self._new_rig = new_rig
        self._open: Rig | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def rig(self) -> Rig:
        """Return an open rig that can begin a session."""
        if self._open is not None and self._open.broken:
            self._close()
        if self._open is None:
            self._open = self._new_rig().__enter__()
        return self._open

    def _close(self) -> None:
        if self._open is not None:
            self._open.__exit__(None, None, None)
            self._open = None
