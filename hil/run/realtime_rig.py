"""A rig against the wall clock, on any python-can interface."""

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from statistics import median
from threading import Thread
from typing import Any

import numpy as np

from dbc.node import PERIOD_NS
from firmware_py.chosen_tuning import chosen_tuning
from hil.bus import link
from hil.bus.link import LinkError
from hil.bus.opening import BusSettings, bus_settings, open_bus
from hil.bus.wire import Clock, Port
from hil.faults.fault import Fault, Stage
from hil.run.listener import Listener
from hil.run.node_processes import MODULES, NodeProcesses, load_record
from hil.run.options import (
    HUB_GREETING,
    INTERRUPTED,
    SIDES,
    BenchError,
    InterruptedRunError,
    Recording,
    RigOptions,
)
from hil.run.realtime import RealtimeNode
from hil.run.rig import Rig
from hil.supervisor import BRING_UP_PERIODS, Supervisor
from plant_sim.machine import Machine

_POLL_S = 0.05
_SHORTEST_WAIT_S, _LONGEST_WAIT_S = 0.001, 0.1
_SILENT_PERIODS, _SILENT_S = 100, 2.0
"""A side from which nothing is heard for as long as the longer of the two is lost."""
_GOODBYE_PERIODS = 5
_MEASURED_PERIODS = 10
_SAME_RATIO = 1.5
"""Factor up to which a measured ratio is that of the bench: a machine that stalls delays some frames."""

_ANSWER_TIMEOUT_S = 10.0
"""How long sides that were heard before may be silent between two sessions, s."""


class RealtimeRig(Rig):
    """Supervisor and log here, plant and firmware in processes of their own, or somebody else's.

    Without an interface, a hub of our own serves `hilbus`, whatever python-can's configuration names.

    Raises
    ------
    can.CanInitializationError
        On entry, if the bus cannot be opened.
    BenchError
        If another machine or tuning is asked for than that of a side which is not started here; on entry, if
        a side does not come up.
    """

    mode = "realtime"

    def __init__(self, options: RigOptions) -> None:
        asked = {"plant": options.machine != Machine(), "controller": options.tuning != chosen_tuning()}
        if foreign := [side for side, differs in asked.items() if differs and side not in options.started]:
            what = {"plant": "--machine", "controller": "--calibration"}[foreign[0]]
            raise BenchError(f"the {foreign[0]} is not started here: start it with {what} yourself")
        super().__init__(options)
        self._session: RealtimeSession | None = None

    @property
    def broken(self) -> bool:
        """Whether a process was lost."""
        return self.processes.any_ended or (self._session is not None and self._session.broken)

    def finish(self) -> str:
        """Let the processes that were started here write their records and end; say what went wrong."""
        if self._session is not None:
            self._session.stop()
        self.processes.terminate()
        self.processes.wait()
        return self.processes.failure()

    def check(self) -> None:
        """Make sure that what was started here lives, and that the bus is heard.

        Raises
        ------
        BenchError
            With what went wrong.
        """
        self.processes.check()
        if self.listener.raised is not None:
            raise BenchError(str(self.listener.raised))

    def check_sides(self) -> None:
        """Make sure that both sides are still heard.

        Raises
        ------
        BenchError
            Naming the one that has gone silent.
        """
        longest_s = max(_SILENT_PERIODS * PERIOD_NS / 1e9 / float(self.options.rt_ratio), _SILENT_S)
        heard_ns = self.listener.newest_ns
        for side, can_ids in self._signs_of_life.items():
            newest_ns = max(heard_ns.get(can_id, 0) for can_id in can_ids)
            silent_s = (time.monotonic_ns() - newest_ns) / 1e9
            if silent_s > longest_s:
                raise BenchError(f"the {side} has been silent for {silent_s:.1f} s: does it still run?")

    def _open(self, stack: ExitStack) -> None:
        settings = stack.enter_context(_bus_to_use(self.options))
        self.bus = stack.enter_context(open_bus(*settings))
        self.hub_channel = settings.channel if settings.interface == "hilbus" else None
        fd = self.hub_channel is not None  # of other interfaces it may need an adapter for CAN FD
        self.listener = Listener(stack.enter_context(open_bus(*settings, fd=fd)))
        self.processes = stack.enter_context(NodeProcesses(self.options, settings))
        stack.enter_context(self.listener.listening())
        self._wait_for_both_sides(self.options.start_timeout_s)
        stack.callback(self._end_session)

    def _begin(self, supervisor: Supervisor, bit_rate: int) -> "RealtimeSession":
        if bit_rate != self.bit_rate:
            raise BenchError(f"this bus runs at {self.bit_rate} bit/s: the test needs virtual time")
        self._end_session()
        self._wait_for_both_sides(min(self.options.start_timeout_s, _ANSWER_TIMEOUT_S))
        self._session = RealtimeSession(self, supervisor)
        return self._session

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.end()

    def _wait_for_both_sides(self, timeout_s: float) -> None:
        """Wait until both sides are heard from now on, and make sure that they keep our time."""
        self.listener.forget()
        options = self.options
        beacons = {side: can_ids[0] for side, can_ids in self._signs_of_life.items()}
        silent, times = list(beacons), {}
        deadline_s = time.monotonic() + timeout_s
        while silent:
            self.check()
            if options.stopped.is_set():
                raise InterruptedRunError("interrupted during start-up")
            if time.monotonic() > deadline_s:
                raise BenchError(self._what_is_missing(silent[0], timeout_s))
            time.sleep(_POLL_S)
            times = {side: self.listener.times_ns(can_id) for side, can_id in beacons.items()}
            silent = [side for side in beacons if len(times[side]) <= _MEASURED_PERIODS]
        for side in SIDES - options.started:
            self._check_ratio(side, times[side])

    @property
    def _signs_of_life(self) -> dict[str, tuple[int, ...]]:
        """What each side sends, first what it sends once a period: a silent sensor is no silent plant."""
        contract = self.contract
        return {
            "plant": (contract.position_feedback.can_id, contract.drive_status.can_id),
            "controller": (contract.drive_command.can_id,),
        }

    def _what_is_missing(self, side: str, timeout_s: float) -> str:
        remedy = "raise --start-timeout if this machine is slow"
        if side not in self.options.started:
            ratio = float(self.options.rt_ratio)
            remedy = f"start it with `python -m {MODULES[side]} -i ... -c ... --rt-ratio {ratio:g}`"
        where = self.bus.channel_info
        return f"nothing was heard of the {side} on {where} within {timeout_s:g} s: {remedy}"

    def _check_ratio(self, side: str, times_ns: list[int]) -> None:
        ours = float(self.options.rt_ratio)
        theirs = PERIOD_NS / max(median(after - before for before, after in pairwise(times_ns)), 1)
        if not 1 / _SAME_RATIO < theirs / ours < _SAME_RATIO:
            raise BenchError(
                f"the {side} runs at --rt-ratio {theirs:.2g}, this bench at {ours:g}: "
                "start both with the same, one that the machine can keep"
            )


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
        self._reached = 0
        self._thread = Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def inject(self, fault: Fault, origin_ns: int) -> None:
        """Have something go wrong that the sides can do themselves; see `hil.run.rig.Session`."""

        def never(bus_ns: int, action: Callable[[], None]) -> None:
            raise AssertionError("what needs this needs a wire, and is refused before")

        fault.inject(Stage(self._rig.contract, self.supervisor, None, {}, never), origin_ns)

    def run_to(self, period: int) -> None:
        """Wait until a period, counted from power-on, has begun, and all before it is over."""
        period_s = PERIOD_NS / 1e9 / float(self._rig.options.rt_ratio)
        while self.supervisor.next_period <= period and not self.ending:
            wait_s = (period - self.supervisor.next_period) * period_s
            time.sleep(min(max(wait_s, _SHORTEST_WAIT_S), _LONGEST_WAIT_S))
            self._check()
        self._reached = min(period, self.supervisor.next_period)
        self._wall_s = time.perf_counter() - self._begin_s

    def recording(self) -> Recording:
        """Return what there is up to where `run_to` came; records only of processes that have ended."""
        options, supervisor = self._rig.options, self.supervisor.record.columns_by_name()
        begin_ns = self.supervisor.start_ns - BRING_UP_PERIODS * PERIOD_NS
        until_ns = begin_ns + self._reached * PERIOD_NS
        shown = supervisor["time_ns"] < until_ns
        traffic = self._rig.listener.traffic(options.rt_ratio)
        times_ns = traffic[:, 0]
        traffic = traffic[(times_ns >= begin_ns) & (times_ns < until_ns)]
        records = {name: load_record(options, name) for name in SIDES & options.started}
        return Recording(
            traffic=traffic,
            supervisor={name: column[shown] for name, column in supervisor.items()},
            plant=records.get("plant"),
            controller=records.get("controller"),
            start_ns=self.supervisor.start_ns,
            simulated_s=self._reached * PERIOD_NS / 1e9,
            wall_s=self._wall_s,
            startup_s=self._startup_s,
            ending=self.ending,
            broken=self.broken,
            execution_ns=options.firmware.execution_ns,
            payloads=self._rig.listener.payloads,
            data_bit_rate=options.data_bit_rate,
            notes={
                "rt_ratio": float(options.rt_ratio),
                "supervisor_lateness": self._runner.lateness.summary(),
                "injected_faults": self._injected_faults(begin_ns, until_ns),
                "injections": self._injections(traffic),
            },
        )

    def end(self) -> None:
        """Withdraw the enable, then stop; idempotent."""
        if self._thread.is_alive() and not self.broken:
            self.supervisor.steer(enable=0)
            self._goodbye = self.supervisor.next_period + _GOODBYE_PERIODS
            self._thread.join()
        self.stop()

    def stop(self) -> None:
        """Stop at once; idempotent."""
        self._stopping = True
        self._thread.join()

    def _injected_faults(self, begin_ns: int, until_ns: int) -> list[dict[str, Any]]:
        """Return the faults that the hub was asked for in a time, as in a scenario; `at_s` in node time."""
        if self._rig.hub_channel is None:
            return []
        ratio, found = self._rig.options.rt_ratio, []
        with suppress(LinkError):  # a hub that has gone tells no more
            connection, answer = link.connect(self._rig.hub_channel, {"role": "faults"})
            connection.close()
            for fault in answer["faults"]:
                asked_ns = self._rig.listener.node_ns(round(fault.pop("bus_time_s") * 1e9), ratio)
                if begin_ns <= asked_ns < until_ns:
                    since_start_s = (asked_ns - self.supervisor.start_ns) / 1e9
                    found.append(fault | {"at_s": since_start_s + fault.get("at_s", 0.0) * float(ratio)})
        return found

    def _injections(self, traffic: np.ndarray) -> list[tuple[float, int, int, int]]:
        """Return the frames on the bench channel that are not the supervisor's, their times in s."""
        bench_channel = list(self._rig.contract.bench_channel_ids)
        own, found = Counter(map(tuple, self.supervisor.bench_frames)), []
        for time_ns, *frame in traffic[np.isin(traffic[:, 1], bench_channel)].tolist():
            if own[tuple(frame)]:
                own[tuple(frame)] -= 1
            else:
                found.append((time_ns / 1e9, *frame))
        return found

    def _run(self) -> None:
        try:
            self._runner.start()
            self._runner.run(self._keep_running)
        except Exception as error:  # of the bus or of a user's reference: `run_to` tells
            self._raised = error

    def _keep_running(self) -> bool:
        if self._goodbye is not None and self.supervisor.next_period >= self._goodbye:
            return False
        return not self._stopping

    def _check(self) -> None:
        """See whether something has ended the run."""
        try:
            if self._raised is not None:
                raise BenchError(f"{type(self._raised).__name__}: {self._raised}")
            self._rig.check()
            self._rig.check_sides()
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
    command += ["--data-bitrate", str(options.data_bit_rate)]
    with subprocess.Popen(
        [*command, "--parent", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
    ) as hub:
        try:
            assert hub.stdout is not None
            said = hub.stdout.readline().strip()
            if not said.startswith(HUB_GREETING):
                last = (said, *hub.stdout.read().strip().splitlines())[-1]
                raise BenchError(last.removeprefix("hil: ") or "the bus process ended silently")
            yield BusSettings("hilbus", channel, bit_rate)
        finally:
            hub.terminate()
