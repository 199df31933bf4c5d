"""The host's side of a guest: statuses, limits, traces. The cheap tests have a shell script as the kernel."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from uml_packages import MODULES

RUNNER = Path(__file__).with_name("guest.py")
LIMIT_S = 120.0


@dataclass(frozen=True)
class Runner:
    """How to start the runner, and where it keeps its traces."""

    tmp: Path
    cwd: Path
    options: tuple[str, ...] = ()
    env: dict[str, str] = field(default_factory=dict)

    def start(self, *command: str, timeout_s: float = LIMIT_S) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, str(RUNNER), f"--timeout-s={timeout_s}", *self.options, "--", *command],
            cwd=self.cwd,
            env={**os.environ, "TMPDIR": str(self.tmp), **self.env},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *command: str, timeout_s: float = LIMIT_S) -> tuple[int, str, str]:
        process = self.start(*command, timeout_s=timeout_s)
        output, errors = process.communicate()
        return process.returncode, output, errors

    def guest_processes(self) -> list[str]:
        """Return the processes of this runner's guests: they work in the run directory."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                cwd = os.readlink(process / "cwd")
            except OSError:  # it has ended, or is another user's
                continue
            if cwd.startswith(f"{self.tmp}/"):
                found.append(process.name)
        return found


@pytest.fixture
def runner(tmp_path: Path) -> Iterator[Runner]:
    """A runner with its own temporary directory, of which nothing may be left after the test."""
    with tempfile.TemporaryDirectory() as tmp:
        runner = Runner(tmp=Path(tmp), cwd=tmp_path)
        yield runner
        assert runner.guest_processes() == []
        assert list(runner.tmp.iterdir()) == []


@pytest.fixture
def with_kernel(runner: Runner, tmp_path: Path) -> Callable[[str], Runner]:
    """Return a runner whose guest's kernel is the given shell script."""

    def with_kernel(script: str) -> Runner:
        for module in MODULES:
            file = tmp_path / f"cache/root/usr/lib/uml/modules/1/kernel/{module}.ko"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
        write_program(tmp_path / "cache/root/usr/bin/linux.uml", script)
        return replace(runner, options=(f"--cache-dir={tmp_path}/cache",))

    return with_kernel


@pytest.fixture
def with_apt_get(runner: Runner, tmp_path: Path) -> Callable[[str], Runner]:
    """Return a runner that has no packages yet, and the given shell script as apt-get."""

    def with_apt_get(script: str) -> Runner:
        write_program(tmp_path / "bin/apt-get", script)
        path = f"{tmp_path}/bin:{os.environ['PATH']}"
        return replace(runner, options=(f"--cache-dir={tmp_path}/cache",), env={"PATH": path})

    return with_apt_get


def write_program(file: Path, script: str) -> None:
    file.parent.mkdir(parents=True)
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)


def wait_until(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


@pytest.mark.parametrize("status", [0, 3])
def test_the_status_the_guest_leaves_is_the_exit_status(
    with_kernel: Callable[[str], Runner], status: int
) -> None:
    assert with_kernel(f"echo {status} >status").run("true") == (status, "", "")


def test_a_guest_without_a_status_fails_and_shows_the_end_of_its_log(
    with_kernel: Callable[[str], Runner],
) -> None:
    status, _, errors = with_kernel("seq 1000; echo Kernel panic - not syncing").run("true")
    assert status == 125
    assert errors.startswith("guest: it ended without an exit status")
    assert errors.endswith("1000\nKernel panic - not syncing\n")


def test_the_time_limit_ends_every_process_of_the_guest(with_kernel: Callable[[str], Runner]) -> None:
    hanging = with_kernel("trap '' TERM; sleep 1000 & sleep 1000")
    assert hanging.run("true", timeout_s=0.5) == (124, "", "guest: ended at the time limit of 0.5 s\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_every_process_of_the_guest(
    with_kernel: Callable[[str], Runner], number: signal.Signals
) -> None:
    hanging = with_kernel("sleep 1000 & sleep 1000")
    process = hanging.start("true")
    wait_until(hanging.guest_processes)
    process.send_signal(number)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (128 + number, f"guest: ended by {number.name}\n")


def test_without_packages_one_line_says_what_to_do(with_apt_get: Callable[[str], Runner]) -> None:
    status, output, errors = with_apt_get("echo 'E: no route' >&2; exit 100").run("true")
    assert (status, output) == (125, "")
    assert errors.count("\n") == 1
    assert "user-mode-linux and can-utils (apt-get: E: no route)" in errors
    assert "`apt-get update`" in errors


def test_a_signal_ends_the_download(with_apt_get: Callable[[str], Runner], tmp_path: Path) -> None:
    process = with_apt_get(f"touch {tmp_path}/started; exec sleep 1000").start("true")
    wait_until((tmp_path / "started").exists)
    process.terminate()
    process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    assert list((tmp_path / "cache").iterdir()) == []


@pytest.mark.boots_guest
@pytest.mark.parametrize("status", [0, 3])
def test_a_command_runs_as_on_the_host(runner: Runner, tmp_path: Path, status: int) -> None:
    greeted = replace(runner, env={"GREETING": "grüß dich"})
    script = f'echo "$GREETING from $(uname -r), $VCAN_JOB"; echo written >file; exit {status}'
    returned, output, errors = greeted.run("sh", "-c", script)
    assert (returned, errors) == (status, "")
    assert output.startswith("grüß dich from ")
    assert output.endswith(", 1\n")
    assert os.uname().release not in output
    assert (tmp_path / "file").read_text() == "written\n"


@pytest.mark.boots_guest
def test_no_byte_of_a_long_output_is_lost_or_changed(runner: Runner) -> None:
    assert runner.run("seq", "200000") == (0, "".join(f"{number}\n" for number in range(1, 200001)), "")


@pytest.mark.boots_guest
def test_an_unknown_command_is_named(runner: Runner) -> None:
    status, output, _ = runner.run("no-such-command")
    assert status == 127
    assert output.startswith("guest: cannot run no-such-command in ")


@pytest.mark.boots_guest
def test_a_signal_ends_a_booted_guest(runner: Runner) -> None:
    process = runner.start("sh", "-c", "echo booted; sleep 1000 & sleep 1000")
    assert process.stdout is not None
    assert process.stdout.readline() == "booted\n"
    process.terminate()
    assert process.communicate() == ("", "guest: ended by SIGTERM\n")
    assert process.returncode == 128 + signal.SIGTERM


@pytest.mark.boots_guest
def test_a_panic_fails_and_is_shown(runner: Runner) -> None:
    status, output, errors = runner.run("sh", "-c", "echo before; echo c >/proc/sysrq-trigger")
    assert (status, output) == (125, "before\n")
    assert "Kernel panic - not syncing: sysrq triggered crash" in errors
