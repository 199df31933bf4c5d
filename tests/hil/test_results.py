"""What a run leaves: figures, trace, bus log and picture that agree with one another."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, hil, played

from dbc.contract import Contract
from dbc.frame import Frame
from hil import cli
from hil.bus.messages import to_frame, to_message
from hil.report import OutputDirectory
from hil.run.options import BenchError
from hil.supervisor import BRING_UP_PERIODS

CONTRACT = Contract.load()
PERIODS = 10_000
FILES = {"result.json", "trace.csv", "bus.log", "picture.png"}
RUN = ("run", "sine", "--mode", "inprocess", "--tuning", "paper")
SHORT_RUN = (*RUN, "--duration", "0.3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short run."""
    out = tmp_path_factory.mktemp("out") / "deep" / "sine"
    assert cli.main([*RUN, "--out", str(out)]) == 0
    return out


@pytest.fixture
def result(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


@pytest.fixture
def trace(folder: Path) -> dict[str, np.ndarray]:
    with open(folder / "trace.csv", newline="") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, dtype=float).T, strict=True))


def test_the_folder_holds_four_files_and_nothing_else(folder):
    assert {file.name for file in folder.iterdir()} == FILES


# result.json


def test_the_result_has_the_keys_that_others_rely_on(result):
    demanded = {
        "scenario": "sine",
        "controller": "adrc",
        "mode": "inprocess",
        "complete": True,
        "paper": {"rms_mm": 0.4276, "max_mm": 1.514},
        "limits": {"rms_mm": 0.1, "max_mm": 0.25},
        "within_limits": True,
        "bit_rate": 1_000_000,
        "simulated_s": 0.001 * (PERIODS + BRING_UP_PERIODS),
    }
    assert {key: result[key] for key in demanded} == demanded
    for key in ("rms_mm", "max_mm", "bus_load_percent", "wall_s", "startup_s", "realtime_factor"):
        assert math.isfinite(result[key])
        assert result[key] > 0
    for key in ("feedback_age_us", "setpoint_age_us", "latency_us", "jitter_us"):
        figure = result["timing"][key]
        assert set(figure) == {"p50", "p99", "max"}
        assert figure["p50"] <= figure["p99"] <= figure["max"]
    assert (result["timing"]["missed_periods"], result["timing"]["late_periods"]) == (0, 0)
    assert result["timing"]["timer"] == "recorded"
    assert len(bytes.fromhex(result["bus_sha256"])) == 32
    assert result["realtime_factor"] == pytest.approx(result["simulated_s"] / result["wall_s"])


def test_a_cut_run_is_not_judged_by_what_holds_for_the_whole(tmp_path):
    assert cli.main([*RUN, "--duration", "0.1", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["paper"], result["limits"], result["within_limits"]) == (None, None, None)


def test_a_controller_that_never_ran_is_said_so(tmp_path, capsys):
    saturated = [*RUN, "--duration", "0.1", "--bitrate", "125000", "--out", str(tmp_path)]
    assert cli.main(saturated) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "the controller was in standby at 0.000 s" in line


def test_a_run_leaves_nothing_of_an_earlier_one(tmp_path):
    for log in (".asc", ".log"):
        assert cli.main([*RUN, "--duration", "0.1", "--log", log, "--out", str(tmp_path)]) == 0
    assert {file.name for file in tmp_path.iterdir()} == FILES


def test_json_on_standard_output_is_the_file(tmp_path, capsys):
    assert cli.main([*SHORT_RUN, "--json", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "result.json").read_text())


def test_a_run_without_terminal_keeps_standard_error_clean(tmp_path):
    ended = hil(*SHORT_RUN, "--json", "--out", str(tmp_path))
    assert (ended.returncode, ended.stderr) == (0, "")
    json.loads(ended.stdout)


# trace.csv


def test_the_trace_has_a_row_for_each_period_and_units_in_its_names(trace):
    assert np.array_equal(trace["time_s"], np.round(np.arange(PERIODS) * 1e-3, 9))
    units = ("_s", "_m", "_m_s", "_m_s2", "_m_s3", "_bar", "_rpm", "_n")
    unitless = {"drive_state", "controller_state", "controller_faults"}
    assert all(name in unitless or name.endswith(units) for name in trace)
    assert {
        "reference_m",
        "position_m",
        "error_m",
        "target_velocity_rpm",
        "motor_speed_rpm",
        "pressure_a_bar",
        "eso_disturbance_m_s3",
    } <= trace.keys()
    assert all(np.isfinite(column).all() for column in trace.values())


def test_rms_and_maximum_follow_from_the_trace(result, trace):
    error_mm = (trace["reference_m"] - trace["position_m"]) * 1e3
    assert result["rms_mm"] == pytest.approx(np.sqrt(np.mean(error_mm**2)), rel=1e-6)
    assert result["max_mm"] == pytest.approx(np.abs(error_mm).max(), rel=1e-6)
    assert np.allclose(trace["error_m"], error_mm * 1e-3, atol=1e-9)


def test_chatter_follows_from_the_trace(result, trace):
    steps_rpm = np.diff(trace["target_velocity_rpm"])
    assert result["chatter_rpm_per_period"] == pytest.approx(np.sqrt(np.mean(steps_rpm**2)))


def test_the_error_starts_with_the_first_period_of_the_reference(trace):
    assert trace["reference_m"][0] == 0.0
    assert trace["reference_m"][1] > 0.0
    assert abs(trace["position_m"][0]) < 5e-6


# the bus log


def test_candump_lines_carry_bus_time(folder):
    first = (folder / "bus.log").read_text().splitlines()[0]
    assert first.startswith("(0.0000")
    assert " can0 " in first


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".mf4", ".trc", ".txt"])
def test_every_log_format_is_written(tmp_path, suffix):
    assert cli.main([*SHORT_RUN, "--log", suffix, "--out", str(tmp_path)]) == 0
    assert (tmp_path / f"bus{suffix}").stat().st_size > 1000


@pytest.mark.parametrize("extended", [False, True])
def test_messages_and_frames_convert_both_ways(extended):
    frame = Frame(0x123 | (0x8000_0000 if extended else 0), 3, 0x030201)
    message = to_message(1_500_000_000, frame, "can0")
    assert message.timestamp == 1.5
    assert message.is_extended_id is extended
    assert bytes(message.data) == b"\x01\x02\x03"
    assert to_frame(message) == frame


# the picture


def test_the_picture_is_a_picture(folder):
    head = (folder / "picture.png").read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(head[16:20], "big") > 500


@pytest.mark.parametrize("controller", ["p", "pi"])
def test_every_controller_gets_one(tmp_path, controller):
    cli.main([*SHORT_RUN, "--controller", controller, "--out", str(tmp_path)])
    assert (tmp_path / "picture.png").stat().st_size > 10_000


# nothing half-written


def test_files_appear_only_when_all_are_there(tmp_path):
    run = played("sine")
    with OutputDirectory(tmp_path, ".log") as directory:
        assert directory.scratch.parent == tmp_path
        (directory.scratch / "begun").write_text("x")
    assert list(tmp_path.iterdir()) == []
    with OutputDirectory(tmp_path, ".log") as directory:
        assert {path.name for path in directory.write(run.result, run.trace, run.recording)} == FILES
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_a_new_run_replaces_the_old_one(tmp_path):
    assert cli.main([*SHORT_RUN, "--out", str(tmp_path)]) == 0
    old = (tmp_path / "trace.csv").read_text()
    assert cli.main([*SHORT_RUN, "--controller", "p", "--out", str(tmp_path)]) in (0, 1)
    assert (tmp_path / "trace.csv").read_text() != old
    assert {file.name for file in tmp_path.iterdir()} == FILES


def test_an_unknown_suffix_is_refused_before_the_run(tmp_path):
    with pytest.raises(BenchError, match="choose one of"):
        OutputDirectory(tmp_path / "new", ".xyz")
    assert not (tmp_path / "new").exists()


# exit codes and help


def test_missed_limits_are_an_exit_code_of_their_own(tmp_path):
    strict = tmp_path / "strict.toml"
    strict.write_text(
        'title = "hard"\nreference = "sine"\nduration_s = 0.3\n[limits.adrc]\nrms_mm = 1e-6\nmax_mm = 1e-6\n'
    )
    run = ["run", str(strict), "--mode", "inprocess", "--out", str(tmp_path / "out")]
    assert cli.main([*run, "--controller", "adrc"]) == 1
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["within_limits"] is False
    assert result["scenario"] == "strict"
    assert result["paper"] is None


def test_limits_for_other_laws_than_the_one_played_are_mentioned(tmp_path, capsys):
    scenario = tmp_path / "other.toml"
    scenario.write_text(
        'title = "other"\nreference = "sine"\nduration_s = 0.1\n[limits.pi]\nrms_mm = 1\nmax_mm = 1\n'
    )
    assert cli.main(["run", str(scenario), "--mode", "inprocess", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert said == "hil: not judged: other has limits for pi, none for scheduled\n"


def test_a_reader_that_has_enough_ends_it_quietly():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as pipe:
        ended = subprocess.run(
            [sys.executable, "-m", "hil", "vcan", "status"],
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            timeout=SAFETY_NET_S,
        )
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, "")


def test_without_limits_there_are_none_to_miss(tmp_path):
    assert cli.main([*RUN, "--controller", "p", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "result.json").read_text())["within_limits"] is None


def test_the_list_names_every_scenario(capsys):
    assert cli.main(["list"]) == 0
    listed = capsys.readouterr().out
    assert all(
        name in listed for name in ("sine", "sine_load", "lift_lower", "lift_lower_load", "full_stroke")
    )


@pytest.mark.parametrize(
    "command",
    [
        ["--help"],
        ["run", "--help"],
        ["sweep", "--help"],
        ["replay", "--help"],
        ["bus", "--help"],
        ["inject", "--help"],
        ["list", "--help"],
        ["tune", "--help"],
        ["faults", "--help"],
        ["reproduce", "--help"],
        ["rta", "--help"],
        ["cost", "--help"],
    ],
    ids=" ".join,
)
def test_help_fits_a_screen(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        cli.main(command)
    assert ended.value.code == 0
    fits_a_screen(capsys.readouterr().out)


@pytest.mark.parametrize("module", ["plant_sim", "firmware_py"])
def test_help_of_a_single_side_fits_a_screen(module, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    from importlib import import_module

    with pytest.raises(SystemExit):
        import_module(f"{module}.__main__").main(["--help"])
    fits_a_screen(capsys.readouterr().out)


def fits_a_screen(text: str) -> None:
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(len(line) for line in lines) <= 80


def test_the_table_shows_the_figures_beside_the_papers(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    cli.main([*RUN, "--out", str(tmp_path)])
    said = capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    for text in (
        f"{result['rms_mm']:.4f}",
        "0.4276",
        "1.5140",
        "bus load",
        "feedback to command",
        "times real time",
    ):
        assert text in said
    assert "result.json" in said
