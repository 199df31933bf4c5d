"""Virtual time, and a rig with all nodes in this process."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS, Node
from firmware_py.node import PHASE_NS
from hil.bus import link
from hil.bus.agenda import Agenda
from hil.bus.wire import DEFAULT_DATA_BIT_RATE, Clock, Port, Wire
from hil.faults.fault import Fault, Stage
from hil.run.options import (
    INTERRUPTED,
    BenchError,
    Recording,
    RigOptions,
    RunOptions,
    check_bit_rate,
    check_data_bit_rate,
)
from hil.run.rig import Rig, play
from hil.supervisor import Supervisor
from plant_sim.node import Plant

SERVICE_NS = 10 * PERIOD_NS
"""Virtual time between looks at stop requests and listeners."""

CLOCKS = {"supervisor": Clock(), "plant": Clock(), "controller": Clock(PHASE_NS)}

Records = dict[str, dict[str, np.ndarray] | None]


def run_inprocess(options: RunOptions) -> Recording:
    """Play a scenario with all nodes in this process."""
    with InprocessRig(options) as rig:
        return play(rig, options)


class InprocessRig(Rig):
    """All nodes in this process; every session has new ones."""

    mode = "inprocess"
    broken = False

    def finish(self) -> str:
        """Have nothing to end."""
        return ""

    def _open(self, stack: ExitStack) -> None:
        """Have nothing to start."""

    def _begin(self, supervisor: Supervisor, bit_rate: int) -> "VirtualSession":
        machine, tuning = self.options.machine, self.options.tuning
        plant = Plant(self.contract, machine.parameters, machine.sensor(), machine.delay_periods)
        firmware = self.options.firmware.controller(self.contract, tuning.calibration.to_bytes())

        def records() -> Records:
            return {node.name: node.record.columns_by_name() for node in (plant, firmware)}

        return VirtualSession(
            self.options,
            self.contract,
            make_wire(self.contract, bit_rate, self.options.data_bit_rate),
            supervisor,
            [plant, firmware],
            records,
            begin_s=self.begin_s,
        )


class VirtualSession:
    """A run in virtual time; see `hil.run.rig.Session`.

    Parameters
    ----------
    options : RigOptions
        What the rig was asked for.
    contract : Contract
        The DBC.
    wire : Wire
        A new one.
    supervisor : Supervisor
        A new one.
    nodes : sequence of Node or Askable
        The others.
    records : callable
        Returns the other nodes' records by name.
    service : callable
        Called every `SERVICE_NS` of bus time.
    begin_s : float
        `time.perf_counter` when start-up began.
    """

    def __init__(
        self,
        options: RigOptions,
        contract: Contract,
        wire: Wire,
        supervisor: Supervisor,
        nodes: Sequence[Node | link.Askable],
        records: Callable[[], Records],
        service: Callable[[], None] = lambda: None,
        begin_s: float = 0.0,
    ) -> None:
        self.supervisor = supervisor
        self.ending = ""
        self.broken = False
        self.wire: Wire = wire
        self._options = options
        self._records = records
        self._service = service
        self.ports: dict[str, Port] = {}
        for node in (supervisor, *nodes):
            self.ports[node.name] = wire.attach(node, CLOCKS[node.name])
        self._agenda = Agenda(wire, self._give_up)
        self.stage = Stage(contract, supervisor, wire, self.ports, self._agenda.at)
        self._startup_s = time.perf_counter() - begin_s
        self._wall_s = 0.0
        self._advance(self._power_on)

    def inject(self, fault: Fault, origin_ns: int) -> None:
        """Have something go wrong; see `hil.run.rig.Session`."""
        fault.inject(self.stage, origin_ns)

    def run_to(self, period: int) -> None:
        """Go on to the start of a period, counted from power-on."""
        self._advance(lambda: self._run(period * PERIOD_NS))

    def recording(self) -> Recording:
        """Return what there is so far."""
        records = self._records()
        return Recording(
            traffic=self.wire.traffic,
            supervisor=self.supervisor.record.columns_by_name(),
            plant=records["plant"],
            controller=records["controller"],
            start_ns=self.supervisor.start_ns,
            simulated_s=self.wire.now_ns / 1e9,
            wall_s=self._wall_s,
            startup_s=self._startup_s,
            ending=self.ending,
            broken=self.broken,
            execution_ns=self._options.firmware.execution_ns,
            payloads=self.wire.payloads,
            data_bit_rate=self.wire.data_bit_rate,
            notes=self._notes(),
        )

    def end(self) -> None:
        """Have nothing to do: virtual time stands still."""

    def _power_on(self) -> None:
        for port in self.ports.values():
            self.wire.start(port)

    def _run(self, end_ns: int) -> None:
        while not self.ending and self.wire.now_ns < end_ns:
            self._agenda.run(min(self.wire.now_ns + SERVICE_NS, end_ns))
            self._service()
            if self._options.stopped.is_set():
                self.ending = INTERRUPTED

    def _give_up(self, error: ValueError) -> None:
        """End a run with too many faults at a time."""
        raise BenchError(f"at bus time {self.wire.now_ns / 1e9:.6f} s: {error}") from error

    def _advance(self, step: Callable[[], None]) -> None:
        begin_s = time.perf_counter()
        try:
            step()
        finally:
            self._wall_s += time.perf_counter() - begin_s

    def _notes(self) -> dict[str, object]:
        return {}


def make_wire(contract: Contract, bit_rate: int, data_bit_rate: int = DEFAULT_DATA_BIT_RATE) -> Wire:
    """Return a wire on which the contract's bench channel is out of band."""
    check_bit_rate(bit_rate)
    check_data_bit_rate(data_bit_rate, bit_rate)
    return Wire(bit_rate, contract.bench_channel_ids, data_bit_rate)
