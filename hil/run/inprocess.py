"""A run with all nodes in this process, in virtual time."""

import time
from collections.abc import Callable

import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.node import PHASE_NS, Controller
from firmware_py.tuning import Tuning
from hil.bus.wire import Clock, Wire
from hil.run.options import INTERRUPTED, Recording, RunOptions
from hil.supervisor import Supervisor
from plant_sim.node import Plant
from plant_sim.parameters import PlantParameters

SERVICE_NS = 10 * PERIOD_NS
"""Virtual time between looks at stop requests, progress and listeners."""


def run_inprocess(options: RunOptions) -> Recording:
    """Run all nodes in this process."""
    begin_s = time.perf_counter()
    contract = Contract.load(options.dbc)
    supervisor = Supervisor(contract, options.scenario, options.controller)
    plant = Plant(contract, PlantParameters())
    controller = Controller(contract, Tuning().calibration().to_bytes())
    wire = make_wire(contract, options.wire_bit_rate)
    for node, clock in ((supervisor, None), (plant, None), (controller, Clock(PHASE_NS))):
        wire.start(wire.attach(node, clock))
    ready_s = time.perf_counter()
    ending = play(wire, supervisor, options, lambda: None)
    wall_s = time.perf_counter() - ready_s
    return Recording(
        traffic=traffic_of(wire),
        supervisor=supervisor.record.columns_by_name(),
        plant=plant.record.columns_by_name(),
        controller=controller.record.columns_by_name(),
        start_ns=supervisor.start_ns,
        simulated_s=wire.now_ns / 1e9,
        wall_s=wall_s,
        startup_s=ready_s - begin_s,
        ending=ending,
    )


def make_wire(contract: Contract, bit_rate: int) -> Wire:
    """Return a wire on which the contract's bench channel is out of band."""
    out_of_band = frozenset(message.can_id for message in contract.messages if message.bench_channel)
    return Wire(bit_rate, out_of_band)


def play(wire: Wire, supervisor: Supervisor, options: RunOptions, service: Callable[[], None]) -> str:
    """Run the wire to the end of the scenario; return what ended it earlier, or nothing."""
    end_ns = supervisor.periods * PERIOD_NS
    while True:
        wire.run(min(wire.now_ns + SERVICE_NS, end_ns))
        service()
        options.progress(wire.now_ns / 1e9)
        if wire.now_ns >= end_ns:
            return ""
        if options.stopped.is_set():
            return INTERRUPTED


def traffic_of(wire: Wire) -> np.ndarray:
    """Return the wire's traffic as rows of end time (ns), id, dlc, data."""
    return wire.traffic
