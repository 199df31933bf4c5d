"""Run a command where a real ``vcan0`` exists: in a User-Mode Linux guest, an ordinary process.

    python tests/vcan/guest.py [--timeout-s S] -- COMMAND...

The guest's root is this machine's file system, read and write, as the user who starts it; only /proc, /sys,
/dev and /run are its own. It has one CPU and no network but lo. Working directory and environment are carried
over, VCAN_JOB=1 is added, and can-utils (candump, cansend, ...) is on PATH. Standard output and standard
error are one terminal there and standard output here; standard input is empty. The exit status is the
command's, or

    124   the time limit passed
    125   there was no guest, or it ended without the command's exit status
    127   the command could not be started
    128+n signal n ended the run (n = 13: standard output was closed)
"""

import argparse
import ctypes
import json
import os
import select
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from uml_packages import GuestError, kernel_modules, unpacked

EXIT_TIME_LIMIT = 124
EXIT_NO_GUEST = 125
EXIT_CANNOT_RUN = 127

CACHE_DIR = Path(__file__).resolve().parents[2] / ".cache" / "uml"
MEMORY_MIB = 2048
KERNEL_LOG_TAIL_LINES = 40
PR_SET_CHILD_SUBREAPER = 36
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StoppedError(Exception):
    """The command did not run to its end; `status` is the runner's exit status."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def main() -> int:
    """Run the command line and return the exit status."""
    parser = argparse.ArgumentParser(description="Run a command where a real vcan0 exists.")
    parser.add_argument(
        "--timeout-s", type=float, default=600, help="limit of a guest (default: %(default)s)"
    )
    parser.add_argument("--native", action="store_true", help="use this machine's own vcan0, no guest")
    parser.add_argument("--cache-dir", type=Path, default=CACHE_DIR, help="packages (default: %(default)s)")
    parser.add_argument("command", nargs="+", help="program and arguments, after `--`")
    arguments = parser.parse_args()
    for number in STOP_SIGNALS:
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    try:
        if arguments.native:
            run_natively(arguments.command)
        return run_in_guest(arguments.command, unpacked(arguments.cache_dir.resolve()), arguments.timeout_s)
    except StoppedError as stopped:
        print(f"guest: {stopped}", file=sys.stderr)
        return stopped.status
    except GuestError as error:
        print(f"guest: {error}", file=sys.stderr)
        return EXIT_NO_GUEST


def run_natively(command: list[str]) -> NoReturn:
    """Become the command, on this machine and its own ``vcan0``."""
    if not Path("/sys/class/net/vcan0").exists():
        raise GuestError("this machine has no vcan0; a guest has one: leave out --native")
    try:
        os.execvpe(command[0], command, {**os.environ, "VCAN_JOB": "1"})
    except OSError as error:
        raise StoppedError(EXIT_CANNOT_RUN, f"cannot run {command[0]}: {error.strerror}") from None


def run_in_guest(command: list[str], packages: Path, timeout_s: float) -> int:
    """Boot a guest, run the command in it, copy its output to ours, and return its exit status.

    Raises
    ------
    StoppedError
        The time limit passed, a signal came, or our output was closed.
    GuestError
        The guest ended without the command's exit status.
    """
    with tempfile.TemporaryDirectory(prefix="uml-") as name:
        run_dir = Path(name)
        write_job(run_dir, command, packages)
        with stop_signals() as stop, guest_kernel(run_dir, packages) as (ended, output):
            copy_until_end(ended, output, stop, timeout_s)
        try:
            return int((run_dir / "status").read_text())
        except (OSError, ValueError):
            log = (run_dir / "kernel.log").read_text(errors="replace").splitlines()
            tail = "\n".join(log[-KERNEL_LOG_TAIL_LINES:])
            raise GuestError(f"it ended without an exit status; the end of its log:\n{tail}") from None


def write_job(run_dir: Path, command: list[str], packages: Path) -> None:
    """Write what the guest reads: the job, and an executable that starts `guest_init.py` as process 1."""
    path = os.environ.get("PATH", os.defpath)
    environment = {**os.environ, "VCAN_JOB": "1", "PATH": f"{path}:{packages}/usr/bin"}
    if not sys.stdout.isatty():
        environment["TERM"] = "dumb"  # the guest's terminal ends in a pipe or a file: no colours
    job = {
        "command": command,
        "cwd": os.getcwd(),
        "env": environment,
        "modules": [str(path) for path in kernel_modules(packages)],
    }
    (run_dir / "job.json").write_text(json.dumps(job))
    init = [sys.executable, "-IS", str(Path(__file__).resolve().with_name("guest_init.py")), str(run_dir)]
    (run_dir / "init").write_text(f"#!/bin/sh\nexec {shlex.join(init)}\n")
    (run_dir / "init").chmod(0o755)


@contextmanager
def stop_signals() -> Iterator[int]:
    """Turn `STOP_SIGNALS` into bytes on the descriptor this yields: none interrupts the cleaning up."""
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    signal.set_wakeup_fd(write_end)
    before = {number: signal.signal(number, lambda *_: None) for number in STOP_SIGNALS}
    try:
        yield read_end
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(-1)
        os.close(read_end)
        os.close(write_end)


@contextmanager
def guest_kernel(run_dir: Path, packages: Path) -> Iterator[tuple[int, int]]:
    """Start the guest; yield a descriptor readable once it has ended, and one to read its output from.

    All its processes form a process group and end with the context: at once, for a guest process that
    outlives its kernel would make its system calls on this machine. The group is not the caller's, because a
    kernel that panics signals its whole group.
    """
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)  # so that all of the group can be waited for
    one_cpu = max(os.sched_getaffinity(0))  # several slow it down
    read_end, write_end = os.pipe()
    command = [
        *("taskset", "-c", str(one_cpu), str(packages / "usr/bin/linux.uml")),
        *(f"mem={MEMORY_MIB}M", f"uml_dir={run_dir}", "umid=guest"),
        *("rootfstype=hostfs", "root=/dev/root", "rootflags=/", "rw", f"init={run_dir}/init"),
        *("con=null", "con0=null,fd:1", f"con1=null,fd:{write_end}"),
    ]
    with open(run_dir / "kernel.log", "wb") as log:
        kernel = subprocess.Popen(
            command,
            cwd=run_dir,
            env={"HOME": str(run_dir), "TMPDIR": memory_dir()},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=[write_end],
            start_new_session=True,
        )
    os.close(write_end)
    ended = os.pidfd_open(kernel.pid)
    try:
        yield ended, read_end
    finally:
        os.killpg(kernel.pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while True:
                os.waitpid(-kernel.pid, 0)
        os.close(ended)
        os.close(read_end)


def memory_dir() -> str:
    """Return a directory for the guest's memory, a deleted file mapped executable: /dev/shm if it will do."""
    with suppress(OSError):
        shm = os.statvfs("/dev/shm")
        if shm.f_bavail * shm.f_frsize >= MEMORY_MIB << 20 and not shm.f_flag & os.ST_NOEXEC:
            return "/dev/shm"
    return tempfile.gettempdir()


def copy_until_end(ended: int, output: int, stop: int, timeout_s: float) -> None:
    """Copy `output` to standard output until `ended` is readable and all is copied."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        remaining_s = deadline_s - time.monotonic()
        if remaining_s <= 0:
            raise StoppedError(EXIT_TIME_LIMIT, f"ended at the time limit of {timeout_s:g} s")
        ready, _, _ = select.select([ended, output, stop], [], [], remaining_s)
        if stop in ready:
            number = signal.Signals(os.read(stop, 1)[0])
            raise StoppedError(128 + number, f"ended by {number.name}")
        if output in ready and (chunk := os.read(output, 65536)):
            try:
                sys.stdout.buffer.write(chunk)
                sys.stdout.buffer.flush()
            except BrokenPipeError:
                raise StoppedError(128 + signal.SIGPIPE, "ended, standard output was closed") from None
        elif ended in ready:
            return


if __name__ == "__main__":
    sys.exit(main())
