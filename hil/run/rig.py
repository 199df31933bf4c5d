"""What a bench consists of in every mode: a rig that stays, and one session on it after another."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Protocol, Self

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.chosen_tuning import ChosenTuning
from hil.bus.wire import Port, Wire
from hil.faults.fault import Fault
from hil.run.options import Recording, RigOptions, RunOptions
from hil.scenario import PERIOD_S
from hil.supervisor import BRING_UP_PERIODS, Supervisor
from plant_sim.machine import Machine

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

    def inject(self, fault: Fault, origin_ns: int) -> None:
        """Have something go wrong, its time counting from `origin_ns` after power-on.

        Raises
        ------
        FaultError
            If it cannot be had here.
        """

    def run_to(self, period: int) -> None:
        """Go on to the start of a period, counted from power-on, or until something ends the run."""

    def recording(self) -> Recording:
        """Return what there is so far."""

    def end(self) -> None:
        """Leave the machine disabled; idempotent."""


class Rig(ABC):
    """Bus and nodes; a context manager, at whose end all that it started has ended.

    Parameters
    ----------
    options : RigOptions
        What it is made of.

    Attributes
    ----------
    mode : str
        "inprocess", "lockstep" or "realtime".
    contract : Contract
        The DBC.
    bit_rate : int
        Bit/s, if a session does not ask for another.
    begin_s : float
        `time.perf_counter` when start-up began.
    """

    mode: str

    def __init__(self, options: RigOptions) -> None:
        self.options = options
        self.contract = Contract.load(options.dbc)
        self.bit_rate = options.wire_bit_rate
        self.begin_s = time.perf_counter()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def begin(self, controller: str, position_m: float, bit_rate: int | None = None) -> Session:
        """Reset all nodes and begin a run under a control law, with the machine at rest at `position_m`.

        Raises
        ------
        BenchError
            If the bus cannot have that bit rate, or a process was lost.
        """
        supervisor = Supervisor(self.contract, controller, position_m)
        return self._begin(supervisor, self.bit_rate if bit_rate is None else bit_rate)

    @property
    @abstractmethod
    def broken(self) -> bool:
        """Whether a process was lost, so that no further session can begin."""

    @abstractmethod
    def finish(self) -> str:
        """End the node processes that were started; return what went wrong with them, or nothing."""

    @abstractmethod
    def _open(self, stack: ExitStack) -> None:
        """Start what has to be there for all sessions."""

    @abstractmethod
    def _begin(self, supervisor: Supervisor, bit_rate: int) -> Session: ...


def play(rig: Rig, options: RunOptions) -> Recording:
    """Play a scenario on a rig that is not used afterwards."""
    scenario = options.scenario
    session = rig.begin(options.controller, scenario.initial_m)
    session.supervisor.plan_scenario(scenario)
    for fault in scenario.faults:
        session.inject(fault, BRING_UP_PERIODS * PERIOD_NS)
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
    """Keeps a rig open for as long as its context lasts; replaces one that is broken, or not the one needed.

    Parameters
    ----------
    new_rig : callable
        Returns a rig with a machine and a tuning that has not been entered.
    """

    def __init__(self, new_rig: Callable[[Machine, ChosenTuning], Rig]) -> None:
        self._new_rig = new_rig
        self._open: Rig | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def rig(self, machine: Machine, tuning: ChosenTuning) -> Rig:
        """Return an open rig that can begin a session on a machine under a tuning."""
        if self._open is not None and not self._fits(self._open, machine, tuning):
            self._close()
        if self._open is None:
            self._open = self._new_rig(machine, tuning).__enter__()
        return self._open

    @staticmethod
    def _fits(rig: Rig, machine: Machine, tuning: ChosenTuning) -> bool:
        return not rig.broken and (rig.options.machine, rig.options.tuning) == (machine, tuning)

    def _close(self) -> None:
        if self._open is not None:
            self._open.__exit__(None, None, None)
            self._open = None
