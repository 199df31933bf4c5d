"""Plant and firmware as child processes of the bench."""

import ctypes
import gc
import importlib
import multiprocessing
import os
import signal
import stat
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hil.bus.opening import BusSettings
from hil.run.options import BenchError, RigOptions

MODULES = {"plant": "plant_sim", "controller": "firmware_py"}
_FORK: Any = multiprocessing.get_context("fork")
_PR_SET_NAME = 15
_END_TIMEOUT_S = 5.0
_LAST_MOMENTS_S = 1.0


def side_arguments(name: str, options: RigOptions, bus: BusSettings) -> list[str]:
    """Return the command line of a side; the firmware's calibration is a file in the record directory."""
    arguments = ["--machine", options.machine.text]
    if name == "controller":
        block = options.record_directory / "calibration.bin"
        block.write_bytes(options.tuning.calibration.to_bytes())
        arguments = ["--calibration", str(block), "--firmware", options.firmware.text]
    arguments += ["-i", bus.interface, "-c", bus.channel, "--rt-ratio", str(options.rt_ratio)]
    arguments += ["--record", str(options.record_directory), "--parent", str(os.getpid())]
    if bus.bit_rate is not None:
        arguments += ["-b", str(bus.bit_rate)]
    if options.dbc is not None:
        arguments += ["--dbc", str(options.dbc)]
    return arguments


def _be_side(name: str, arguments: list[str], log: Path) -> None:
    """Become a side of its own: nothing of the bench but its memory stays."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for request in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(request, signal.SIG_DFL)
    _close_sockets()
    with suppress(AttributeError, OSError):  # Linux: what `ps` shows
        ctypes.CDLL(None).prctl(_PR_SET_NAME, f"hil-{name}".encode(), 0, 0, 0)
    gc.freeze()  # a collection would copy the shared memory
    with open(os.devnull, "r+") as nothing, open(log, "w", buffering=1) as words:
        for descriptor, stream in enumerate((nothing, nothing, words)):
            os.dup2(stream.fileno(), descriptor)
        sys.stdin, sys.stdout, sys.stderr = nothing, nothing, words
        try:
            code = importlib.import_module(f"{MODULES[name]}.__main__").main(arguments)
        except Exception:
            traceback.print_exc()
            code = 1
        sys.exit(code)


def _close_sockets() -> None:
    """Close the bench's sockets: their other ends have to see when the bench ends."""
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        with suppress(OSError):
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                os.close(descriptor)


class NodeProcesses:
    """Starts both sides on one channel, watches them and ends them.

    They are forked, so that they start at once and share the interpreter's memory, which makes switching
    between partners on one core twice as fast; each is what ``python -m plant_sim`` would be otherwise. They
    get a session of their own: Ctrl-C reaches the bench only, which then ends them in order.

    Parameters
    ----------
    options : RigOptions
        Says which sides to start; real-time ratio, DBC and record directory are handed on.
    bus : BusSettings
        The bus they are to meet on.
    """

    def __init__(self, options: RigOptions, bus: BusSettings) -> None:
        self._logs = {name: options.record_directory / f"{name}.stderr" for name in sorted(options.started)}
        self._processes = {
            name: _FORK.Process(
                target=_be_side, args=(name, side_arguments(name, options, bus), log), daemon=True
            )
            for name, log in self._logs.items()
        }
        for process in self._processes.values():
            process.start()

    def __enter__(self) -> "NodeProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        self.terminate()
        self.wait()

    @property
    def pids(self) -> list[int]:
        """Process ids."""
        return [process.pid for process in self._processes.values() if process.pid is not None]

    @property
    def any_ended(self) -> bool:
        """Whether a process that was started has ended."""
        return any(process.exitcode is not None for process in self._processes.values())

    def check(self) -> None:
        """Make sure that both are alive.

        Raises
        ------
        BenchError
            With what the process wrote last.
        """
        for name, process in self._processes.items():
            if process.exitcode is not None:
                words = self.last_words(name) or "silently"
                raise BenchError(f"the {name} process ended{self.exit_code(name)}: {words}")

    def exit_code(self, name: str) -> str:
        """Return how a process ended, in words for a message."""
        self._processes[name].join(_LAST_MOMENTS_S)
        code = self._processes[name].exitcode
        return "" if code is None else f" (exit code {code})"

    def last_words(self, name: str) -> str:
        """Return the last line a process wrote to its standard error."""
        said = self._logs[name].read_text(errors="replace").strip().splitlines()
        return said[-1] if said else ""

    def failure(self) -> str:
        """Return what went wrong after both have ended, or nothing."""
        for name, process in self._processes.items():
            if process.exitcode not in (0, None):
                return (
                    f"the {name} process ended{self.exit_code(name)}: {self.last_words(name) or 'silently'}"
                )
        return ""

    def terminate(self) -> None:
        """Ask both to end."""
        for process in self._processes.values():
            if process.is_alive():
                process.terminate()

    def kill(self, name: str) -> None:
        """End one that does not listen any more."""
        self._processes[name].kill()

    def wait(self) -> None:
        """Wait for both to end; kill what does not."""
        deadline_s = time.monotonic() + _END_TIMEOUT_S
        for process in self._processes.values():
            process.join(max(deadline_s - time.monotonic(), 0.1))
            if process.is_alive():
                process.kill()
                process.join()


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
