"""A rig against the wall clock, on any python-can interface."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from threading import Thread
from typing import Self

import can
import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from hil.bus.messages import to_frame
from hil.bus.opening import BusSettings, bus_settings, open_bus
from hil.bus.wire import Clock, Port
from hil.run.node_processes import NodeProcesses, load_record
from hil.run.options import (
    HUB_GREETING,
    INTERRUPTED,
    SIDES,
    BenchError,
    InterruptedRunError,
    Recording,
    RigOptions,
    RunOptions,
)
from hil.run.realtime import RealtimeNode, shared_ns
from hil.run.rig import play
from hil.supervisor import Supervisor

_POLL_S = 0.05
_WAIT_S = 0.002
_CHECK_INTERVAL_S = 0.1
_GOODBYE_PERIODS = 5


def run_realtime(options: RunOptions) -> Recording:
    """Play a scenario against the wall clock.

    Raises
    ------
    can.CanInitializationError
        If the bus cannot be opened.
    BenchError
        If a side does not come up.
    """
    with RealtimeRig(options) as rig:
        return play(rig, options)


class RealtimeRig:
    """Supervisor and log here, plant and firmware in processes of their own, or somebody else's.

    Without an interface, a hub of our own serves `hilbus`, whatever python-can's configuration names.

    Raises
    ------
    can.CanInitializationError
        On entry, if the bus cannot be opened.
    BenchError
        On entry, if a side does not come up.
    """

    mode = "realtime"

    def __init__(self, options: RigOptions) -> None:
        self.contract = Contract.load(options.dbc)
        self.options = options
        self.bit_rate = options.wire_bit_rate
        self.begin_s = time.perf_counter()
        self.heard: list[tuple[int, can.Message]] = []
        self._session: RealtimeSession | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            settings = stack.enter_context(_bus_to_use(self.options))
            self.bus = stack.enter_context(open_bus(*settings))
            listener = stack.enter_context(open_bus(*settings))
            self.processes = stack.enter_context(NodeProcesses(self.options, settings))
            self._wait_for_both_sides(listener)
            notifier = can.Notifier(
                listener,
                [lambda message: self.heard.append((time.monotonic_ns(), message))],
                timeout=_POLL_S,
            )
            stack.callback(notifier.stop)
            stack.callback(self._end_session)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def broken(self) -> bool:
        """Whether a process was lost."""
        return self._session is not None and self._session.broken

    def begin(self, controller: str, position_m: float, bit_rate: int | None = None) -> "RealtimeSession":
        """Begin a run; see `hil.run.rig.Rig`."""
        if bit_rate not in (None, self.bit_rate):
            raise BenchError(f"this bus runs at {self.bit_rate} bit/s: the test needs virtual time")
        self._end_session()
        self.heard.clear()
        self._session = RealtimeSession(self, Supervisor(self.contract, controller, position_m))
        return self._session

    def finish(self) -> str:
        """Let the processes that were started here write their records and end; say what went wrong."""
        if self._session is not None:
            self._session.stop()
        self.processes.terminate()
        self.processes.wait()
        return self.processes.failure()

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.end()

    def _wait_for_both_sides(self, listener: can.BusABC) -> None:
        options, contract = self.options, self.contract
        waiting_for = {
            contract.position_feedback.can_id: "plant",
            contract.drive_command.can_id: "controller",
        }
        deadline_s = time.monotonic() + options.start_timeout_s
        while waiting_for:
            self.processes.check()
            if options.stopped.is_set():
                raise InterruptedRunError("interrupted during start-up")
            if time.monotonic() > deadline_s:
                missing = next(iter(waiting_for.values()))
                remedy = "raise --start-timeout if this machine is slow"
                if missing not in options.started:
                    module = {"plant": "plant_sim", "controller": "firmware_py"}[missing]
                    remedy = f"start it with `python -m {module} -i ... -c ...`"
                raise BenchError(
                    f"nothing was heard of the {missing} on {listener.channel_info} within "
                    f"{options.start_timeout_s:g} s: {remedy}"
                )
            message = listener.recv(_POLL_S)
            if message is not None and not message.is_extended_id:
                waiting_for.pop(message.arbitration_id, None)


class RealtimeSession:
    """A run against the wall clock; see `hil.run.rig.Session`.

    The supervisor runs in a thread, so that setpoints keep coming while a test computes.
    """

    wire = None
    ports: Mapping[str, Port] = {}

    def __init__(self, rig: RealtimeRig, supervisor: Supervisor) -> None:
        self.supervisor = supervisor
        self.ending = ""
        self.broken = False
        self._rig = rig
        self._runner = RealtimeNode(supervisor, rig.bus, rig.options.rt_ratio, Clock())
        self._startup_s = time.perf_counter() - rig.begin_s
        self._begin_s = time.perf_counter()
        self._wall_s = 0.0
        self._goodbye: int | None = None
        self._stopping = False
        self._raised: Exception | None = None
        self._check_s = 0.0
        self._reached = 0
        self._thread = Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def run_to(self, period: int) -> None:
        """Wait until the start of a period, counted from power-on."""
        while self.supervisor.next_period < period and not self.ending:
            time.sleep(_WAIT_S)
            self._check()
        self._reached = min(period, self.supervisor.next_period)
        self._wall_s = time.perf_counter() - self._begin_s

    def recording(self) -> Recording:
        """Return what there is up to where `run_to` came; records only of processes that have ended."""
        options, supervisor = self._rig.options, self.supervisor.record.columns_by_name()
        shown = supervisor["time_ns"] < supervisor["time_ns"][:1] + self._reached * PERIOD_NS
        traffic = _traffic(list(self._rig.heard), options.rt_ratio)
        until_ns = supervisor["time_ns"][0] + self._reached * PERIOD_NS if len(shown) else 0
        records = {name: load_record(options, name) for name in SIDES & options.started}
        return Recording(
            traffic=traffic[traffic[:, 0] < until_ns],
            supervisor={name: column[shown] for name, column in supervisor.items()},
            plant=records.get("plant"),
            controller=records.get("controller"),
            start_ns=self.supervisor.start_ns,
            simulated_s=self._reached * PERIOD_NS / 1e9,
            wall_s=self._wall_s,
            startup_s=self._startup_s,
            ending=self.ending,
            broken=self.broken,
            notes={
                "rt_ratio": float(options.rt_ratio),
                "supervisor_lateness": self._runner.lateness.summary(),
            },
        )

    def end(self) -> None:
        """Withdraw the enable, then stop; idempotent."""
        if self._thread.is_alive() and not self.ending:
            self.supervisor.steer(enable=0)
            self._goodbye = self.supervisor.next_period + _GOODBYE_PERIODS
            self._thread.join()
        self.stop()

    def stop(self) -> None:
        """Stop at once; idempotent."""
        self._stopping = True
        self._thread.join()

    def _run(self) -> None:
        try:
            self._runner.start()
            self._runner.run(self._keep_running)
        except (can.CanError, OSError) as error:
            self._raised = error

    def _keep_running(self) -> bool:
        if self._goodbye is not None and self.supervisor.next_period >= self._goodbye:
            return False
        return not self._stopping

    def _check(self) -> None:
        """See whether something has ended the run."""
        if time.monotonic() < self._check_s:
            return
        self._check_s = time.monotonic() + _CHECK_INTERVAL_S
        try:
            if self._raised is not None:
                raise BenchError(str(self._raised))
            self._rig.processes.check()
        except BenchError as error:
            self.ending, self.broken = str(error), True
        if self._rig.options.stopped.is_set():
            self.ending = INTERRUPTED


@contextmanager
def _bus_to_use(options: RigOptions) -> Iterator[BusSettings]:
    """Say which bus; without an interface, that of a hub process for the time of the run."""
    if options.interface is not None:
        yield bus_settings(options.interface, options.channel, options.bit_rate)
        return
    channel = options.channel or f"run-{os.getpid()}"
    bit_rate = options.wire_bit_rate
    command = [sys.executable, "-m", "hil", "bus", "--channel", channel, "--bitrate", str(bit_rate)]
    hub = subprocess.Popen(
        [*command, "--parent", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        assert hub.stdout is not None
        said = hub.stdout.readline().decode(errors="replace").strip()
        if not said.startswith(HUB_GREETING):
            raise BenchError(said.removeprefix("hil: "))
        yield BusSettings("hilbus", channel, bit_rate)
    finally:
        hub.terminate()
        hub.wait()


def _traffic(heard: list[tuple[int, can.Message]], ratio: Fraction) -> np.ndarray:
    """Put the log on the nodes' time base: the frame that was passed on fastest ties the two clocks."""
    data = [(ns, m) for ns, m in heard if not (m.is_error_frame or m.is_remote_frame or m.is_fd)]
    offset_ns = min((ns - round(message.timestamp * 1e9) for ns, message in data), default=0)
    rows = [
        (
            shared_ns(round(message.timestamp * 1e9) + offset_ns, ratio),
            *to_frame(message),
        )
        for _, message in data
    ]
    return np.array(rows, dtype=np.uint64).reshape(-1, 4)
