"""What a bench consists of in every mode: a rig that stays, and one session on it after another."""

from collections.abc import Mapping
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

    def begin(self, controller: str, position_m: float) -> Session:
        """Reset all nodes and begin a run with the machine at rest at `position_m`."""

    def finish(self) -> str:
        """End the node processes that were started; return what went wrong with them, or nothing."""


def play(rig: Rig, options: RunOptions) -> Recording:
    """Play a scenario on a rig that is not used afterwards."""
    scenario = options.scenario
    session = rig.begin(options.controller, float(scenario.reference_m()[0]))
    session.supervisor.plan(BRING_UP_PERIODS, reference=scenario.position_m)
    for time_s, force_n in scenario.load:
        session.supervisor.plan(BRING_UP_PERIODS + round(time_s / PERIOD_S), load_n=round(force_n))
    end = BRING_UP_PERIODS + scenario.periods
    for period in (*range(PROGRESS_PERIODS, end, PROGRESS_PERIODS), end):
        session.run_to(period)
        if session.ending:
            break
        options.progress(period * PERIOD_S)
    failure = rig.finish()
    recording = session.recording()
    if failure and not recording.ending:
        return replace(recording, ending=failure, broken=True)
    return recording
