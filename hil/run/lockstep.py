"""A run in virtual time with plant and firmware in processes of their own."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.node import PHASE_NS
from hil.bus.hub import Hub, NodeGoneError
from hil.bus.opening import BusSettings
from hil.bus.wire import Clock, Port, Wire
from hil.run.inprocess import make_wire, play, traffic_of
from hil.run.node_processes import NodeProcesses, load_record
from hil.run.options import BenchError, InterruptedRunError, Recording, RunOptions
from hil.supervisor import Supervisor

AFTERMATH_NS = 100 * PERIOD_NS
"""How long the others go on after a process was lost: the drive stops from full speed in 82 ms."""

_MOTOR_AT_REST_RAD_S = 0.1
_POLL_S = 0.02
_NODES = frozenset({"plant", "controller"})


def run_lockstep(options: RunOptions) -> Recording:
    """Run hub and supervisor here, plant and firmware in processes that answer event by event.

    Raises
    ------
    BenchError
        If a process does not come up, or stops answering.
    """
    begin_s = time.perf_counter()
    contract = Contract.load(options.dbc)
    supervisor = Supervisor(contract, options.scenario, options.controller)
    wire = make_wire(contract, options.wire_bit_rate)
    channel = options.channel or f"run-{os.getpid()}"
    with (
        Hub(wire, channel, expected=_NODES, answer_timeout_s=options.answer_timeout_s) as hub,
        NodeProcesses(options, BusSettings("hilbus", channel, options.wire_bit_rate)) as processes,
    ):
        _wait_for_nodes(hub, processes, options)
        with _pinned_to_one_core(processes.pids):
            ports = {
                "supervisor": wire.attach(supervisor),
                "plant": hub.attach("plant"),
                "controller": hub.attach("controller", Clock(PHASE_NS)),
            }
            ready_s = time.perf_counter()
            gone, ending = None, ""
            try:
                for port in ports.values():
                    wire.start(port)
                ending = play(wire, supervisor, options, hub.service)
            except NodeGoneError as error:
                gone, gone_ns = error, wire.now_ns
                if error.silent:
                    processes.kill(error.name)
                _run_without(error, wire, ports)
            wall_s = time.perf_counter() - ready_s
        simulated_s = wire.now_ns / 1e9
        exchanges = sum(wire.exchanges(port) for port in ports.values())
        hub.close()
        processes.wait()
        notes: dict[str, object] = {
            "exchanges_per_period": exchanges * PERIOD_NS / wire.now_ns,
            "listener_drops": hub.dropped,
            "injections": [(time_ns / 1e9, *frame) for time_ns, frame in hub.injections],
        }
    plant, controller = (load_record(options, name) for name in ("plant", "controller"))
    if gone is not None:
        at = f"{gone} at bus time {gone_ns / 1e9:.3f} s"
        if gone.silent:
            raise BenchError(f"{at}: see why it hangs, or raise --answer-timeout")
        ending = f"{at}{processes.exit_code(gone.name)}{_motor_stop(plant, gone_ns)}"
    ending = ending or processes.failure()
    return Recording(
        traffic=traffic_of(wire),
        supervisor=supervisor.record.columns_by_name(),
        plant=plant,
        controller=controller,
        start_ns=supervisor.start_ns,
        simulated_s=simulated_s,
        wall_s=wall_s,
        startup_s=ready_s - begin_s,
        ending=ending,
        broken=gone is not None or bool(processes.failure()),
        notes=notes,
    )


def _wait_for_nodes(hub: Hub, processes: NodeProcesses, options: RunOptions) -> None:
    deadline_s = time.monotonic() + options.start_timeout_s
    while missing := sorted(_NODES - set(hub.nodes)):
        processes.check()
        if options.stopped.is_set():
            raise InterruptedRunError("interrupted during start-up")
        if time.monotonic() > deadline_s:
            raise BenchError(
                f"the {missing[0]} process did not come up within {options.start_timeout_s:g} s: "
                "raise --start-timeout if this machine is slow"
            )
        hub.service(_POLL_S)


def _run_without(gone: NodeGoneError, wire: Wire, ports: dict[str, Port]) -> None:
    """Let the survivors go on for a while, so that their reaction is on record."""
    wire.detach(ports[gone.name])
    try:
        wire.run(wire.now_ns + AFTERMATH_NS)
    except NodeGoneError as another:
        wire.detach(ports[another.name])


def _motor_stop(plant: dict[str, np.ndarray] | None, gone_ns: int) -> str:
    if plant is None or not len(plant["time_ns"]):
        return ""
    resting = np.abs(plant["motor_speed_rad_s"]) < _MOTOR_AT_REST_RAD_S
    moving = plant["time_ns"][~resting]
    if resting[-1]:
        stopped_ns = max(moving.max(initial=0) + PERIOD_NS, gone_ns)
        return f"; the motor was at rest {(stopped_ns - gone_ns) / 1e6:.0f} ms later"
    return "; the motor was still turning when the run ended"


@contextmanager
def _pinned_to_one_core(pids: list[int]) -> Iterator[None]:
    """Keep all partners on one core: an exchange there costs a fraction of one across cores."""
    allowed = os.sched_getaffinity(0)
    core = {min(allowed)}
    everyone = [0, *pids]
    for pid in everyone:
        _set_affinity(pid, core)
    try:
        yield
    finally:
        for pid in everyone:
            _set_affinity(pid, allowed)


def _set_affinity(pid: int, cores: set[int]) -> None:
    with suppress(OSError):  # not permitted here, or the process has ended: only speed depends on it
        os.sched_setaffinity(pid, cores)
