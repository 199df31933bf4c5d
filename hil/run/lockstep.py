"""A rig in virtual time with plant and firmware in processes of their own."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np

from dbc.node import PERIOD_NS
from hil.bus.hub import Hub, NodeGoneError
from hil.bus.opening import BusSettings
from hil.bus.wire import Wire
from hil.faults.catalogue import fault_of_table
from hil.run.inprocess import Records, VirtualSession, make_wire
from hil.run.node_processes import NodeProcesses, forget_record, load_record
from hil.run.options import SIDES, BenchError, InterruptedRunError, Recording, RigOptions, RunOptions
from hil.run.rig import Rig, play
from hil.supervisor import Supervisor

AFTERMATH_NS = 100 * PERIOD_NS
"""How long the others go on after a process was lost: the drive stops from full speed in 82 ms."""

_MOTOR_AT_REST_RAD_S = 0.1
_POLL_S = 0.02


def run_lockstep(options: RunOptions) -> Recording:
    """Play a scenario with hub and supervisor here, plant and firmware in processes.

    Raises
    ------
    BenchError
        If a process does not come up, or stops answering.
    """
    with LockstepRig(options) as rig:
        return play(rig, options)


class LockstepRig(Rig):
    """Hub and supervisor here, plant and firmware in processes that answer event by event.

    Raises
    ------
    BenchError
        On entry, if a process does not come up.
    """

    mode = "lockstep"

    def __init__(self, options: RigOptions) -> None:
        super().__init__(options)
        self._lost = False
        self._finished = False

    @property
    def broken(self) -> bool:
        """Whether a process was lost."""
        return self._lost or self.processes.any_ended

    def give_up(self) -> None:
        """Begin no further session: a process was lost."""
        self._lost = True

    def finish(self) -> str:
        """Let the processes write their records and end; return what went wrong with them."""
        self._finished = True
        self.hub.close()
        self.processes.wait()
        return self.processes.failure()

    def records(self) -> Records:
        """Return what the processes wrote down of themselves since the session began."""
        if not self._finished:
            for node in self.hub.nodes.values():
                with suppress(NodeGoneError):
                    node.save()
        return {name: load_record(self.options, name) for name in SIDES}

    def _open(self, stack: ExitStack) -> None:
        options, bit_rate = self.options, self.bit_rate
        channel = options.channel or f"run-{os.getpid()}"
        wire = make_wire(self.contract, bit_rate, self.options.data_bit_rate)
        self.hub = stack.enter_context(Hub(wire, channel, SIDES, options.answer_timeout_s))
        bus = BusSettings("hilbus", channel, bit_rate)
        self.processes = stack.enter_context(NodeProcesses(options, bus))
        self._wait_for_nodes()
        for pid in self.processes.pids:
            _set_affinity(pid, _one_core())

    def _begin(self, supervisor: Supervisor, bit_rate: int) -> "LockstepSession":
        wire = make_wire(self.contract, bit_rate, self.options.data_bit_rate)
        self.hub.lead_to(wire)
        for name in SIDES:
            forget_record(self.options, name)
            try:
                self.hub.nodes[name].forget()
            except NodeGoneError as error:
                self.give_up()
                raise BenchError(str(error)) from error
        session = LockstepSession(self, wire, supervisor, self.begin_s)
        self.hub.take_fault = session.take_fault
        return session

    def _wait_for_nodes(self) -> None:
        options = self.options
        deadline_s = time.monotonic() + options.start_timeout_s
        while missing := sorted(SIDES - set(self.hub.nodes)):
            self.processes.check()
            if options.stopped.is_set():
                raise InterruptedRunError("interrupted during start-up")
            if time.monotonic() > deadline_s:
                raise BenchError(
                    f"the {missing[0]} process did not come up within {options.start_timeout_s:g} s: "
                    "raise --start-timeout if this machine is slow"
                )
            self.hub.service(_POLL_S)


class LockstepSession(VirtualSession):
    """A run in virtual time that may lose a process."""

    def __init__(self, rig: LockstepRig, wire: Wire, supervisor: Supervisor, begin_s: float) -> None:
        self._rig = rig
        self._injected: list[dict[str, Any]] = []
        nodes = [rig.hub.nodes[name] for name in ("plant", "controller")]
        super().__init__(
            rig.options, rig.contract, wire, supervisor, nodes, rig.records, rig.hub.service, begin_s
        )

    def take_fault(self, table: dict[str, Any]) -> None:
        """Have a fault that somebody asks for from outside, and note when."""
        now_ns = self.wire.now_ns
        fault = fault_of_table(table)
        self.inject(fault, now_ns)
        at_s = fault.at_s + (now_ns - self.supervisor.start_ns) / 1e9
        self._injected.append(fault.table | {"at_s": at_s})

    def _advance(self, step: Callable[[], None]) -> None:
        try:
            with _on_one_core():
                super()._advance(step)
        except NodeGoneError as error:
            self._lose(error)

    def _lose(self, gone: NodeGoneError) -> None:
        """Let the others go on for a while, so that their reaction is on record, and say what happened."""
        self.broken = True
        self._rig.give_up()
        gone_ns = self.wire.now_ns
        at = f"{gone} at bus time {gone_ns / 1e9:.3f} s"
        processes = self._rig.processes
        if gone.silent:
            processes.kill(gone.name)
        lost = gone
        while self.wire.now_ns < gone_ns + AFTERMATH_NS:
            self.wire.detach(self.ports[lost.name])
            try:
                self.wire.run(gone_ns + AFTERMATH_NS)
            except NodeGoneError as another:
                lost = another
        if gone.silent:
            raise BenchError(f"{at}: see why it hangs, or raise --answer-timeout") from gone
        stop = _motor_stop(self._records()["plant"], gone_ns)
        self.ending = f"{at}{processes.exit_code(gone.name)}{stop}"

    def _notes(self) -> dict[str, object]:
        hub = self._rig.hub
        exchanges = sum(self.wire.exchanges(port) for port in self.ports.values())
        return {
            "exchanges_per_period": exchanges * PERIOD_NS / self.wire.now_ns if self.wire.now_ns else 0.0,
            "listener_drops": hub.dropped,
            "injected_faults": self._injected,
            "injections": [(time_ns / 1e9, *frame) for time_ns, frame in hub.injections],
        }


def _motor_stop(plant: dict[str, np.ndarray] | None, gone_ns: int) -> str:
    if plant is None or not len(plant["time_ns"]):
        return ""
    resting = np.abs(plant["motor_speed_rad_s"]) < _MOTOR_AT_REST_RAD_S
    moving = plant["time_ns"][~resting]
    if resting[-1]:
        stopped_ns = max(moving.max(initial=0) + PERIOD_NS, gone_ns)
        return f"; the motor was at rest {(stopped_ns - gone_ns) / 1e6:.0f} ms later"
    return "; the motor was still turning when the run ended"


def _one_core() -> set[int]:
    """Return the core of all partners: an exchange there costs a fraction of one across cores."""
    return {min(os.sched_getaffinity(0))}


@contextmanager
def _on_one_core() -> Iterator[None]:
    allowed = os.sched_getaffinity(0)
    _set_affinity(0, _one_core())
    try:
        yield
    finally:
        _set_affinity(0, allowed)


def _set_affinity(pid: int, cores: set[int]) -> None:
    with suppress(OSError):  # not permitted here, or the process has ended: only speed depends on it
        os.sched_setaffinity(pid, cores)
