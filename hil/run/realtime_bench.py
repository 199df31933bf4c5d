"""A run against the wall clock on any python-can interface: plant and firmware in processes of their own."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction

import can
import numpy as np

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from hil.bus.messages import to_frame
from hil.bus.opening import BusSettings, bus_settings, open_bus
from hil.bus.wire import Clock
from hil.run.node_processes import NodeProcesses, load_record
from hil.run.options import HUB_GREETING, INTERRUPTED, BenchError, InterruptedRunError, Recording, RunOptions
from hil.run.realtime import RealtimeNode, shared_ns
from hil.supervisor import Supervisor

_POLL_S = 0.05
_CHECK_INTERVAL_S = 0.1


def run_realtime(options: RunOptions) -> Recording:
    """Run supervisor and log here, plant and firmware in processes of their own.

    Without an interface, a hub of our own serves `hilbus`, whatever python-can's configuration names.

    Raises
    ------
    can.CanInitializationError
        If the bus cannot be opened.
    BenchError
        If a side does not come up or is lost.
    """
    begin_s = time.perf_counter()
    contract = Contract.load(options.dbc)
    supervisor = Supervisor(contract, options.scenario, options.controller)
    with _bus_to_use(options) as settings:
        listener, own = open_bus(*settings), open_bus(*settings)
        with listener, own, NodeProcesses(options, settings) as processes:
            heard: list[tuple[int, can.Message]] = []
            _wait_for_both(listener, contract, processes, options)
            notifier = can.Notifier(
                listener, [lambda message: heard.append((time.monotonic_ns(), message))], timeout=_POLL_S
            )
            runner = RealtimeNode(supervisor, own, options.rt_ratio, Clock())
            ready_s = time.perf_counter()
            broken = ""
            try:
                runner.start()
                runner.run(_until_done(supervisor, processes, options))
            except (BenchError, can.CanError, OSError) as error:
                broken = str(error)
            finally:
                wall_s = time.perf_counter() - ready_s
                notifier.stop()
            processes.terminate()
            processes.wait()
            notes: dict[str, object] = {
                "rt_ratio": float(options.rt_ratio),
                "supervisor_lateness": runner.lateness.summary(),
            }
    record = supervisor.record.columns_by_name()
    played_ns = int(record["time_ns"][-1] - record["time_ns"][0]) + PERIOD_NS if len(record["time_ns"]) else 0
    broken = broken or processes.failure()
    ending = broken or (INTERRUPTED if options.stopped.is_set() else "")
    return Recording(
        traffic=_traffic(heard, options.rt_ratio),
        supervisor=record,
        plant=load_record(options, "plant"),
        controller=load_record(options, "controller"),
        start_ns=supervisor.start_ns,
        simulated_s=played_ns / 1e9,
        wall_s=wall_s,
        startup_s=ready_s - begin_s,
        ending=ending,
        broken=bool(broken),
        notes=notes,
    )


@contextmanager
def _bus_to_use(options: RunOptions) -> Iterator[BusSettings]:
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


def _wait_for_both(
    listener: can.BusABC, contract: Contract, processes: NodeProcesses, options: RunOptions
) -> None:
    waiting_for = {
        contract.position_feedback.can_id: "plant",
        contract.drive_command.can_id: "controller",
    }
    deadline_s = time.monotonic() + options.start_timeout_s
    while waiting_for:
        processes.check()
        if options.stopped.is_set():
            raise InterruptedRunError("interrupted during start-up")
        if time.monotonic() > deadline_s:
            missing = next(iter(waiting_for.values()))
            raise BenchError(
                f"nothing was heard of the {missing} on {listener.channel_info} within "
                f"{options.start_timeout_s:g} s: raise --start-timeout if this machine is slow"
            )
        message = listener.recv(_POLL_S)
        if message is not None and not message.is_extended_id:
            waiting_for.pop(message.arbitration_id, None)


def _until_done(supervisor: Supervisor, processes: NodeProcesses, options: RunOptions) -> Callable[[], bool]:
    next_check_s = 0.0

    def keep_running() -> bool:
        nonlocal next_check_s
        played = supervisor.played_periods
        if time.monotonic() >= next_check_s:
            next_check_s = time.monotonic() + _CHECK_INTERVAL_S
            processes.check()
            options.progress(played * PERIOD_NS / 1e9)
        return played < supervisor.periods and not options.stopped.is_set()

    return keep_running


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
