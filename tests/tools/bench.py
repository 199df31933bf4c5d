"""Speed, measured side by side: ``make bench``.

Every subject is run once to warm up, then in interleaved rounds, so that a noisy machine disturbs all alike;
the median over the rounds counts. Multiples of real time are simulated seconds over wall seconds, without
start-up and output files. Costs per step are of the jitted control step alone, replayed over the inputs of
the scenario ("worst": random setpoints and positions, so that no linear zone saves a power). A plain
Python loop is timed in each round too, to compare machines by.

Lateness is of a 1 ms timer under the same scheduler, once in a bare loop (sleep to 200 µs before an absolute
deadline, then read the clock until it is there) and once in the real-time engine, which sends a frame per
period on a bus served by another process. The ratio is of the two 99th percentiles of the same round.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import can
import numpy as np
from numba import njit
from readme_figures import BENCH, speed_table, write_to_page

from dbc.frame import Frame
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.tuning import Tuning
from hil.bus.wire import Clock
from hil.closed_loop import run_closed_loop
from hil.references import setpoint_counts
from hil.run.inprocess import run_inprocess
from hil.run.lockstep import run_lockstep
from hil.run.options import HUB_GREETING, RunOptions
from hil.run.realtime import SPIN_NS, TICK_MARGIN_NS, RealtimeNode, fifo_scheduling
from hil.scenario import Scenario, load_scenario

PYTHON_LOOP = 1_000_000
LATENESS_PERIODS = 2000


@njit(cache=False)
def _replay(calibration, state, io, setpoints, positions):
    control_reset(calibration, state, io)
    for i in range(setpoints.size):
        io[k.IO_SETPOINT] = setpoints[i]
        io[k.IO_POSITION] = positions[i]
        control_step(calibration, state, io)


def bus_run(run: Callable[[RunOptions], object], scenario: Scenario) -> float:
    """Return multiples of real time of one run over the bus."""
    with tempfile.TemporaryDirectory() as directory:
        recording = run(RunOptions(scenario, "adrc", record_directory=Path(directory)))
    return recording.simulated_s / recording.wall_s


def jitted_loop(scenario: Scenario) -> float:
    """Return multiples of real time of kernel and plant in one jitted loop, without the bus."""
    setpoints, load_n = setpoint_counts(scenario.reference_m()), scenario.load_n()
    calibration = Tuning().calibration()
    begin_s = time.perf_counter()
    run_closed_loop(calibration, setpoints, load_n)
    return scenario.duration_s / (time.perf_counter() - begin_s)


def step_us(law: int, setpoints: np.ndarray, positions: np.ndarray, repeat: int = 20) -> float:
    """Return the cost of one control step in µs, over given inputs (0.1 µm and 1 µm counts)."""
    calibration = Tuning(law=law).calibration().array()
    state, io = np.zeros(k.ST_SIZE, np.int32), np.zeros(k.IO_SIZE, np.int32)
    io[k.IO_LAW] = law
    io[k.IO_POSITION] = positions[0]
    begin_s = time.perf_counter()
    for _ in range(repeat):
        _replay(calibration, state, io, setpoints, positions)
    return (time.perf_counter() - begin_s) / repeat / setpoints.size * 1e6


def python_loop_ms() -> float:
    """Return the time of a fixed piece of plain Python, ms."""
    begin_s = time.perf_counter()
    sum(i * i for i in range(PYTHON_LOOP))
    return (time.perf_counter() - begin_s) * 1e3


def bare_lateness_us() -> np.ndarray:
    """Return how late a bare loop is at each deadline, µs."""
    late_ns = []
    with fifo_scheduling():
        due_ns = next_period(time.monotonic_ns()) + TICK_MARGIN_NS
        while len(late_ns) < LATENESS_PERIODS:
            while (sleep_ns := due_ns - SPIN_NS - time.monotonic_ns()) > 0:
                time.sleep(sleep_ns / 1e9)
            while (now_ns := time.monotonic_ns()) < due_ns:
                pass
            late_ns.append(now_ns - due_ns)
            due_ns += ((now_ns - due_ns) // PERIOD_NS + 1) * PERIOD_NS
    return np.array(late_ns) / 1e3


class Ticker:
    """A node that does nothing but send a frame per period."""

    name = "ticker"
    accepts: frozenset[int] = frozenset()
    latched: frozenset[int] = frozenset()
    transmits = frozenset({0x100})

    def on_start(self, now_ns: int) -> Actions:
        return Actions(next_period(now_ns))

    def on_timer(self, now_ns: int) -> Actions:
        return Actions(next_period(now_ns + 1), ((now_ns, Frame(0x100, 8, now_ns)),))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        return NOTHING


def engine_lateness_us() -> np.ndarray:
    """Return how late the real-time engine is at each deadline, µs."""
    with hub() as channel, can.Bus(interface="hilbus", channel=channel) as bus:
        runner = RealtimeNode(Ticker(), bus, Fraction(1), Clock())
        late_ns = runner.lateness.timer_ns
        runner.start()
        runner.run(lambda: len(late_ns) < LATENESS_PERIODS)
    return np.array(late_ns) / 1e3


@contextmanager
def hub() -> Iterator[str]:
    """Serve a bus from a process of its own and give its channel."""
    channel = f"bench-{os.getpid()}"
    command = [sys.executable, "-m", "hil", "bus", "--channel", channel, "--parent", str(os.getpid())]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        said = process.stdout.readline()
        if not said.startswith(HUB_GREETING):
            raise RuntimeError(f"no bus to measure on: {said}")
        yield channel
    finally:
        process.terminate()
        process.communicate()


def lateness() -> dict[str, float]:
    """Return the figures of one round of lateness, bare loop and engine."""
    bare_p50, bare_p99 = np.percentile(bare_lateness_us(), [50, 99])
    engine_p50, engine_p99 = np.percentile(engine_lateness_us(), [50, 99])
    return {
        "bare_late_p50_us": float(bare_p50),
        "bare_late_p99_us": float(bare_p99),
        "engine_late_p50_us": float(engine_p50),
        "engine_late_p99_us": float(engine_p99),
        "engine_late_p99_ratio": float(engine_p99 / bare_p99),
    }


def subjects() -> dict[str, Callable[[], float | dict[str, float]]]:
    """Return what is measured, by the name it has in ``bench.json``; a dict names its figures itself."""
    sine = load_scenario("sine")
    setpoints = setpoint_counts(sine.reference_m())
    run = run_closed_loop(Tuning().calibration(), setpoints, np.zeros(setpoints.size))
    positions = np.floor(run.position_m * 1e6 + 0.5).astype(np.int32)
    random = np.random.default_rng(1)
    wild_setpoints = random.integers(0, 4_000_000, 10_000).astype(np.int32)
    wild_positions = random.integers(0, 400_000, 10_000).astype(np.int32)
    return {
        "inprocess_x": lambda: bus_run(run_inprocess, sine),
        "lockstep_x": lambda: bus_run(run_lockstep, sine),
        "jitted_loop_x": lambda: jitted_loop(sine),
        "adrc_step_sine_us": lambda: step_us(k.LAW_ADRC, setpoints, positions),
        "adrc_step_worst_us": lambda: step_us(k.LAW_ADRC, wild_setpoints, wild_positions),
        "pi_step_sine_us": lambda: step_us(k.LAW_PI, setpoints, positions),
        "lateness": lateness,
        "python_loop_ms": python_loop_ms,
    }


def main() -> int:
    """Measure, print, and write ``docs/bench.json`` and README's table of it."""
    parser = argparse.ArgumentParser(description="Measure speed, write docs/bench.json and README.")
    parser.add_argument("--rounds", type=int, default=9, help="interleaved rounds (default 9)")
    parser.add_argument("--only", metavar="NAME", help="one subject alone; print it and write nothing")
    arguments = parser.parse_args()
    measured = subjects()
    if arguments.only:
        if arguments.only not in measured:
            parser.error(f"there is no subject {arguments.only!r}: choose from {', '.join(measured)}")
        measured = {arguments.only: measured[arguments.only]}
    samples: dict[str, list[float]] = {}
    for measure in measured.values():
        measure()
    for number in range(arguments.rounds):
        print(f"round {number + 1} of {arguments.rounds}", file=sys.stderr)
        for name, measure in measured.items():
            value = measure()
            for figure, sample in (value if isinstance(value, dict) else {name: value}).items():
                samples.setdefault(figure, []).append(sample)
    figures = {
        name: {"median": statistics.median(values), "min": min(values), "max": max(values)}
        for name, values in samples.items()
    }
    for name, figure in figures.items():
        print(f"{name:22} {figure['median']:10.3f}   ({figure['min']:.3f} .. {figure['max']:.3f})")
    if arguments.only:
        return 0
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    machine["python"] = platform.python_version()
    report = {"rounds": arguments.rounds, "machine": machine, "figures": figures}
    BENCH.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    write_to_page("bench", speed_table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
