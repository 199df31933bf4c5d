"""The loop closed once on a real vcan0: plant, firmware and supervisor are three processes on SocketCAN."""

import json
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest

from dbc.contract import Contract

RT_RATIO = "0.02"
"""Three missed periods are 150 ms of wall time: longer than this kind of guest stalls."""
SETTLING_PERIODS = 100
RUN = 2


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("vcan_sine")
    command = [sys.executable, "-m", "hil", "run", "sine", "--tuning", "paper", "--mode", "realtime"]
    command += ["-i", "socketcan", "-c", "vcan0", "--rt-ratio", RT_RATIO]
    command += ["--duration", "1", "--out", str(out), "--start-timeout", "300"]
    finished = subprocess.run(command, capture_output=True, text=True)
    assert finished.returncode in (0, 1), finished.stderr
    print(finished.stdout)
    return out


@pytest.fixture(scope="module")
def trace(run: Path) -> np.ndarray:
    return np.genfromtxt(run / "trace.csv", delimiter=",", names=True)


def undisturbed(trace: np.ndarray) -> np.ndarray:
    """Return which periods had no missed period on either side within the last 100."""
    missed = np.isnan(trace["position_m"]) | np.isnan(trace["controller_state"])
    recent = np.convolve(missed, np.ones(SETTLING_PERIODS), "full")[: len(missed)]
    print(f"{missed.sum()} periods missed at {trace['time_s'][missed].tolist()} s")
    return recent == 0


def test_the_scenario_is_played_to_its_end(run: Path, trace: np.ndarray):
    assert json.loads((run / "result.json").read_text())["complete"]
    assert len(trace) == 1000


def test_the_controller_stays_in_run(trace: np.ndarray):
    state = trace["controller_state"]
    assert set(state[~np.isnan(state)]) == {RUN}


def test_it_tracks_within_the_gates_where_the_machine_kept_time(trace: np.ndarray):
    judged = undisturbed(trace) & np.isfinite(trace["error_m"])  # no setpoint in a period that was missed
    assert judged.mean() >= 0.5, "inconclusive: the machine stalled too often to judge tracking"
    error_mm = trace["error_m"][judged] * 1e3
    assert np.sqrt(np.mean(error_mm**2)) <= 0.10
    assert np.abs(error_mm).max() <= 0.25


def test_every_message_of_the_contract_was_on_the_bus(run: Path):
    seen = {message.arbitration_id for message in can.LogReader(run / "bus.log")}
    assert {message.can_id & 0x1FFF_FFFF for message in Contract.load().messages} <= seen
