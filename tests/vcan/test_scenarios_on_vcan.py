"""The acceptance scenarios on a real vcan0, one after the other against two processes started by hand."""

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hand_started import CHANNEL, RT_RATIO, Side, both_sides

SCENARIOS = Path(__file__).parents[1] / "scenarios"
SUMMARY = re.compile(r"^hil: (\d+) scenarios? on socketcan, (\d+) passed; .*$", re.MULTILINE)


@pytest.fixture(scope="module")
def sides(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Side]]:
    with both_sides(tmp_path_factory.mktemp("record")) as sides:
        yield sides


def test_every_scenario_that_applies_to_socketcan_passes(
    sides: dict[str, Side], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command = [
        sys.executable,
        "-m",
        "pytest",
        str(SCENARIOS),
        "-v",
        "-p",
        "no:cacheprovider",
        "--durations=0",
        f"--ignore={SCENARIOS / 'test_requirements.py'}",  # collects the suite once for each interface
    ]
    command += ["--hil-mode", "realtime", "--hil-interface", "socketcan", "--hil-channel", CHANNEL]
    command += ["--rt-ratio", str(RT_RATIO), "--hil-out", str(tmp_path / "failed")]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with (
        capfd.disabled(),
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as run,
    ):
        assert run.stdout is not None
        output = ""
        for line in run.stdout:
            print(line, end="", flush=True)
            output += line
    assert run.returncode == 0
    summary = SUMMARY.search(output)
    assert summary
    applicable, passed = map(int, summary.groups())
    table = tomllib.loads((SCENARIOS / "requirements.toml").read_text(encoding="utf-8"))
    assert passed == applicable == table["count"]["socketcan"]["run"]


def test_both_sides_outlived_them(sides: dict[str, Side]) -> None:
    for name, side in sides.items():
        assert side.process.poll() is None
        assert side.said()[0].startswith(f"{name} is on socketcan channel '{CHANNEL}'")
        assert len(side.said()) == 1
