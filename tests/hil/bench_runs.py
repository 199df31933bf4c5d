"""Runs of the bench that the tests of this room share."""

import gc
import hashlib
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from threading import Thread
from typing import Any

from dbc.contract import Contract
from hil.bus.hub import Hub
from hil.bus.wire import Wire
from hil.measure import Trace, result_of, trace_of
from hil.run.inprocess import run_inprocess
from hil.run.options import Recording, RunOptions
from hil.run.stopping import StopFlag
from hil.scenario import Scenario, load_scenario

SAFETY_NET_S = 120.0
"""Longer than anything takes on the slowest machine; reached only when something hangs."""

FORK: Any = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class Played:
    """A run and what was measured of it."""

    recording: Recording
    trace: Trace
    result: dict[str, Any]


@cache
def played(scenario: str, controller: str = "adrc", bit_rate: int = 1_000_000) -> Played:
    """Play a built-in scenario in full, in this process, once for all tests."""
    options = RunOptions(load_scenario(scenario), controller, record_directory=Path(), bit_rate=bit_rate)
    recording = run_inprocess(options)
    contract = Contract.load()
    trace = trace_of(recording, contract)
    return Played(recording, trace, result_of(recording, trace, contract, options, "inprocess"))


def short_scenario(
    duration_s: float = 0.5, load: tuple[tuple[float, float], ...] = (), reference: str = "sine"
) -> Scenario:
    return Scenario("short", "a short one", reference, duration_s, load, {}, {})


def sha256(recording: Recording) -> str:
    return hashlib.sha256(recording.traffic.astype("<u8").tobytes()).hexdigest()


def forked(
    program: Callable[[list[str]], int], arguments: Sequence[str], folder: Path, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a program's main function in a process of its own that need not import everything again."""

    def main(words: int) -> None:
        gc.freeze()  # a collection would copy the shared memory
        os.chdir(folder)
        os.environ.update(environment)
        for stream in (1, 2):
            os.dup2(words, stream)
        with (
            open(1, "w", buffering=1, closefd=False) as stdout,
            open(2, "w", buffering=1, closefd=False) as stderr,
        ):
            sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__ = stdout, stderr
            code = program(list(arguments))
        sys.exit(code)

    with TemporaryFile("w+") as words:
        process = FORK.Process(target=main, args=(words.fileno(),))
        process.start()
        process.join(10 * SAFETY_NET_S)
        if process.exitcode is None:
            process.kill()
            process.join()
        words.seek(0)
        return subprocess.CompletedProcess(arguments, process.exitcode, words.read(), "")


def hil(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "hil", *arguments],
        capture_output=True,
        text=True,
        timeout=SAFETY_NET_S,
        env=os.environ | environment,
    )


@contextmanager
def background(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python module in the background and make sure that it ends with the test."""
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_until(happened: Callable[[], Any], what: str) -> Any:
    """Poll until something is true, and return it."""
    deadline_s = time.monotonic() + SAFETY_NET_S
    while not (value := happened()):
        assert time.monotonic() < deadline_s, f"waited in vain until {what}"
        time.sleep(0.01)
    return value


@contextmanager
def serving(channel: str, bit_rate: int = 1_000_000) -> Iterator[Hub]:
    """Serve a bus in wall time from a thread."""
    stopped = StopFlag()
    with Hub(Wire(bit_rate), channel, expected=None) as hub:
        server = Thread(target=hub.run_in_wall_time, args=(lambda: not stopped.is_set(),))
        server.start()
        try:
            yield hub
        finally:
            stopped.set()
            server.join()


@contextmanager
def busy_machine(processes: int = 2) -> Iterator[None]:
    """Keep every core busy with something else."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def children(pid: int) -> list[int]:
    """Return the living children of a process."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and (fields := _stat(int(entry.name))) and int(fields[1]) == pid:
            found.append(int(entry.name))
    return found


def alive(pid: int) -> bool:
    """Tell whether a process still runs; one that only waits to be reaped does not."""
    fields = _stat(pid)
    return fields is not None and fields[0] not in "ZX"


def name_of(pid: int) -> str:
    """Return what `ps` calls a process."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def _stat(pid: int) -> list[str] | None:
    """Return the fields of /proc/PID/stat from the state on."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
