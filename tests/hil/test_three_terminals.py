"""As README has it: a bus, a plant and a firmware in three terminals, and pytest in a fourth.

Real time is slowed down so far that what is asserted outlives the stalls of a busy machine.
"""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from bench_runs import SAFETY_NET_S, background, busy_machine, forked

CHANNEL = "bench"
RT_RATIO = "0.03"
"""Three missed periods are 100 ms of wall time."""

SCENARIOS = """
import pytest
from firmware_py.diagnosis import State
from hil.references import sine

def test_it_tracks(bench):
    bench.setpoint(sine)
    bench.run(0.3)
    assert bench.controller_state == State.RUN
    assert bench.error_mm.max < 0.5

@pytest.mark.bench(position_m=0.1)
def test_without_setpoints_it_is_safe(bench):
    bench.setpoint(lambda time_s: 0.1 + 0.05 * time_s)
    bench.silence("PositionSetpoint")
    bench.run(0.2)
    assert bench.controller_state == State.SAFE
    assert "SetpointLost" in bench.controller_faults
    assert bench.motor_speed_rpm.last == 0

def test_after_the_reset_it_tracks_again(bench):
    test_it_tracks(bench)
"""

Terminals = dict[str, subprocess.Popen[str]]


@contextmanager
def terminals(*names: str, ratio: str = RT_RATIO) -> Iterator[Terminals]:
    """Start a bus, and the sides that are named, and wait until they say that they are there."""
    with ExitStack() as stack:
        started = {"bus": stack.enter_context(background("hil", "bus", "--channel", CHANNEL))}
        assert started["bus"].stdout is not None
        assert started["bus"].stdout.readline().startswith(f"hilbus channel '{CHANNEL}'")
        for name in names:
            arguments = ["-i", "hilbus", "-c", CHANNEL, "--rt-ratio", ratio]
            started[name] = stack.enter_context(background(name, *arguments))
        for name in names:
            stderr = started[name].stderr
            assert stderr is not None
            assert f"is on hilbus channel '{CHANNEL}'" in stderr.readline()
        yield started


def session(folder: Path, *options: str) -> list[str]:
    """Return the arguments of pytest for a user's scenarios against what is on the bus."""
    (folder / "test_mine.py").write_text(SCENARIOS)
    arguments = ["test_mine.py", "-p", "no:cacheprovider", "--hil-mode", "realtime"]
    return [
        *arguments,
        "--hil-interface",
        "hilbus",
        "--hil-channel",
        CHANNEL,
        "--rt-ratio",
        RT_RATIO,
        *options,
    ]


def scenarios(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a user's scenarios, as from a terminal."""
    command = [sys.executable, "-m", "pytest", *session(folder)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=3 * SAFETY_NET_S)


def refused(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest for what it says before a scenario begins."""
    return forked(pytest.main, [*session(folder, *options), "-p", "no:hypothesispytest"], folder)


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Press Ctrl-C; return exit code and what was said on standard error."""
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=SAFETY_NET_S)
    return process.returncode, said


def play_and_end(folder: Path) -> None:
    with terminals("plant_sim", "firmware_py") as started:
        run = scenarios(folder)
        assert run.returncode == 0, run.stdout
        assert "hil: 3 scenarios on hilbus, 3 passed" in run.stdout
        assert {name: process.poll() for name, process in started.items()} == dict.fromkeys(started)
        for name in reversed(started):
            code, said = end(started[name])
            assert code in (0, 128 + signal.SIGINT), name
            assert "Traceback" not in said


def test_scenarios_run_one_after_the_other_against_the_same_two_processes(tmp_path):
    play_and_end(tmp_path)


@pytest.mark.long
def test_they_do_on_a_busy_machine_too(tmp_path):
    with busy_machine():
        play_and_end(tmp_path)


@pytest.mark.parametrize(
    ("there", "missing", "module"),
    [((), "plant", "plant_sim"), (("plant_sim",), "controller", "firmware_py")],
)
def test_one_line_says_which_side_is_missing_and_how_to_start_it(tmp_path, there, missing, module):
    with terminals(*there):
        run = refused(tmp_path, "--hil-start-timeout", "2")
    assert run.returncode == 2
    (line,) = re.findall(r"hil: .*heard.*", run.stdout + run.stderr)
    assert line.startswith(f"hil: nothing was heard of the {missing} on hilbus channel '{CHANNEL}'")
    assert f"start it with `python -m {module} -i ... -c ... --rt-ratio {RT_RATIO}`" in line
    assert "Traceback" not in run.stdout + run.stderr


def test_one_line_says_that_the_bench_and_a_side_keep_different_time(tmp_path):
    with terminals("plant_sim", "firmware_py", ratio="0.1"):
        run = refused(tmp_path)
    assert run.returncode == 2
    (line,) = re.findall(
        r"hil: the \w+ runs at --rt-ratio ([\d.e-]+), this bench at (\S+): ", run.stdout + run.stderr
    )
    assert float(line[0]) == pytest.approx(0.1, rel=0.4)
    assert line[1] == RT_RATIO
