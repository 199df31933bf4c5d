"""Plant and firmware as child processes of the bench."""

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from hil.bus.opening import BusSettings
from hil.run.options import BenchError, RigOptions

MODULES = {"plant": "plant_sim", "controller": "firmware_py"}
_END_TIMEOUT_S = 5.0
_LAST_MOMENTS_S = 1.0


class NodeProcesses:
    """Starts both sides on one channel, watches them and ends them.

    They get a session of their own, so that Ctrl-C reaches the bench only, which then ends them in order.

    Parameters
    ----------
    options : RigOptions
        Says which sides to start; real-time ratio, DBC and record directory are handed on.
    bus : BusSettings
        The bus they are to meet on.
    """

    def __init__(self, options: RigOptions, bus: BusSettings) -> None:
        self._logs: dict[str, Path] = {}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        arguments = ["-i", bus.interface, "-c", bus.channel, "--rt-ratio", str(options.rt_ratio)]
        arguments += ["--record", str(options.record_directory), "--parent", str(os.getpid())]
        if bus.bit_rate is not None:
            arguments += ["-b", str(bus.bit_rate)]
        if options.dbc is not None:
            arguments += ["--dbc", str(options.dbc)]
        for name in sorted(options.started):
            self._logs[name] = options.record_directory / f"{name}.stderr"
            with open(self._logs[name], "wb") as log:
                self._processes[name] = subprocess.Popen(
                    [sys.executable, "-m", MODULES[name], *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                )

    def __enter__(self) -> "NodeProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        self.terminate()
        self.wait()

    @property
    def pids(self) -> list[int]:
        """Process ids."""
        return [process.pid for process in self._processes.values()]

    def check(self) -> None:
        """Make sure that both are alive.

        Raises
        ------
        BenchError
            With what the process wrote last.
        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                words = self.last_words(name) or "silently"
                raise BenchError(f"the {name} process ended{self.exit_code(name)}: {words}")

    def exit_code(self, name: str) -> str:
        """Return how a process ended, in words for a message."""
        with suppress(subprocess.TimeoutExpired):
            self._processes[name].wait(_LAST_MOMENTS_S)
        code = self._processes[name].poll()
        return "" if code is None else f" (exit code {code})"

    def last_words(self, name: str) -> str:
        """Return the last line a process wrote to its standard error."""
        said = self._logs[name].read_text(errors="replace").strip().splitlines()
        return said[-1] if said else ""

    def failure(self) -> str:
        """Return what went wrong after both have ended, or nothing."""
        for name, process in self._processes.items():
            if process.poll() not in (0, None):
                return (
                    f"the {name} process ended{self.exit_code(name)}: {self.last_words(name) or 'silently'}"
                )
        return ""

    def terminate(self) -> None:
        """Ask both to end."""
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()

    def kill(self, name: str) -> None:
        """End one that does not listen any more."""
        self._processes[name].kill()

    def wait(self) -> None:
        """Wait for both to end; kill what does not."""
        deadline_s = time.monotonic() + _END_TIMEOUT_S
        for process in self._processes.values():
            try:
                process.wait(max(deadline_s - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def forget_record(options: RigOptions, name: str) -> None:
    """Remove what a node wrote down of an earlier session."""
    (options.record_directory / f"{name}.npz").unlink(missing_ok=True)


def load_record(options: RigOptions, name: str) -> dict[str, np.ndarray] | None:
    """Return what a node wrote down of itself; None if it did not live to."""
    path = options.record_directory / f"{name}.npz"
    if not path.exists():
        return None
    with np.load(path) as columns:
        return dict(columns)
