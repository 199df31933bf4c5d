"""`hil sweep`: what it leaves, that nobody but the inputs decides it, and how each run is played again."""

import csv
import json
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.process import BaseProcess as Process
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, alive, children, wait_until

from firmware_py.chosen_tuning import chosen_tuning
from hil import cli
from hil.measure import METRICS
from hil.run.options import BenchError
from hil.scenario import load_scenario
from hil.study.box import load_box
from hil.study.runs import BOX_RUNS, FIGURES, all_cores, box_rms_mm, dask_cluster, failed, figures_of
from hil.study.sweep import Sweep, axis_label
from plant_sim.machine import Machine

FILES = ["picture.png", "samples.csv", "sweep.json"]
SHORT = ["sweep", "sine", "--duration", "0.5", "--samples", "40"]


def swept(out: Path, *arguments: str) -> dict:
    """Run a sweep in this process, however many samples fail, and return sweep.json."""
    assert cli.main([*arguments, "--max-failures", "1000", "--out", str(out)]) == 0
    return json.loads((out / "sweep.json").read_text())


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "samples.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def without_wall_time(out: Path) -> tuple[list[str], bytes]:
    lines = (out / "sweep.json").read_text().splitlines()
    return [line for line in lines if "wall_s" not in line], (out / "samples.csv").read_bytes()


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing, which takes longer than a short sweep."""
    monkeypatch.setattr("hil.study.sweep.draw", lambda path, *_: path.touch())


@contextmanager
def sweeping(out: Path) -> Iterator[Process]:
    """A long sweep in a process of its own, with its workers at work; it says what it says to a file."""

    def sweep() -> None:
        with (out.parent / "said").open("w", buffering=1) as said:
            sys.stderr = said
            os._exit(cli.main(["sweep", "sine", "--samples", "2000", "--workers", "2", "--out", str(out)]))

    process = get_context("fork").Process(target=sweep)
    process.start()
    try:
        wait_until(lambda: len(children(process.pid)) == 2, "the sweep has its workers")
        yield process
    finally:
        process.kill()
        process.join()


def said_by(sweep: Process, out: Path) -> str:
    """Wait for the end of a sweep and return the one line it said."""
    sweep.join(SAFETY_NET_S)
    (line,) = (out.parent / "said").read_text().splitlines()
    return line


@pytest.fixture(scope="module")
def sine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sine on 30 samples of the box under the tuning of the paper."""
    out = tmp_path_factory.mktemp("sine")
    swept(out, "sweep", "sine", "--samples", "30", "--seed", "4", "--tuning", "paper")
    return out


# what it leaves


def test_the_figures_are_those_of_the_samples(sine):
    summary = json.loads((sine / "sweep.json").read_text())
    rms_mm = np.sort([float(row["rms_mm"]) for row in rows(sine)])
    assert summary["samples"] == len(rms_mm) == 30
    assert summary["rms_mm"]["median"] == (rms_mm[14] + rms_mm[15]) / 2
    assert summary["rms_mm"]["p95"] == rms_mm[28]
    assert summary["rms_mm"]["worst"] == summary["worst"]["rms_mm"] == rms_mm[-1]
    assert summary["failures"] == len(summary["failed"]) == np.count_nonzero(rms_mm > 2.0)
    assert 0 < summary["failures"] < 30
    assert summary["wall_s"] > 0
    assert sorted(path.name for path in sine.iterdir()) == FILES


def test_the_median_has_an_interval_of_order_statistics(sine):
    """Ranks 10 and 21 of 30: the binomial's 2.1 % on either side; 11 and 20 would be 4.9 %."""
    rms_mm = np.sort([float(row["rms_mm"]) for row in rows(sine)])
    median = json.loads((sine / "sweep.json").read_text())["rms_mm"]
    assert (median["median_low"], median["median_high"]) == (rms_mm[9], rms_mm[20])


def test_the_share_of_failures_has_the_interval_of_clopper_and_pearson(tmp_path, quickly):
    """None of 40: the upper end solves (1 - p)^40 = 2.5 %."""
    share = swept(tmp_path, *SHORT)["failure_share"]
    assert share["value"] == share["low"] == 0.0
    assert share["high"] == pytest.approx(1 - 0.025 ** (1 / 40), rel=1e-6)


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_more_failures_than_may_are_an_exit_code_and_a_line(tmp_path, capsys, quickly, form):
    arguments = ["sweep", "sine", "--samples", "30", "--seed", "4", "--tuning", "paper", *form]
    out = ["--out", str(tmp_path)]
    assert cli.main([*arguments, *out]) == 1
    said = capsys.readouterr()
    failures = json.loads((tmp_path / "sweep.json").read_text())["failures"]
    line = (
        f"hil: {failures} of 30 samples failed, RMS error above 2 mm or no number; 0 may (--max-failures)\n"
    )
    assert said.err == line
    assert cli.main([*arguments, "--max-failures", str(failures - 1), *out]) == 1
    assert f"{failures - 1} may" in capsys.readouterr().err
    assert cli.main([*arguments, "--max-failures", str(failures), *out]) == 0
    assert capsys.readouterr().err == ""


def test_a_failed_sample_played_over_the_bus_gives_the_same_figures(tmp_path, capsys, quickly):
    """Under P, which fails by lagging: a machine that swings may be stopped on the bus."""
    law = ("--tuning", "paper", "--controller", "p")
    entry = swept(tmp_path, "sweep", "sine", "--samples", "1", "--seed", "4", *law)["failed"][0]
    capsys.readouterr()
    program, *arguments = shlex.split(entry["replay"])
    assert program == "hil"
    assert "--machine" in arguments
    cli.main([*arguments, "--json", "--out", str(tmp_path)])
    result = json.loads(capsys.readouterr().out)
    assert result["rms_mm"] > 2.0
    for metric in METRICS:
        assert result[metric] == entry[metric]
    assert result["machine"] == entry["machine"]
    assert result["tuning"] == "paper"


def test_a_run_under_a_calibration_file_can_be_played_again_too(tmp_path, capsys, quickly):
    block = tmp_path / "my tuning.bin"
    block.write_bytes(chosen_tuning("pi_star").calibration.to_bytes())
    summary = swept(tmp_path / "out", *SHORT, "--calibration", str(block))
    assert summary["controller"] == "pi"
    capsys.readouterr()
    cli.main([*shlex.split(summary["worst"]["replay"])[1:], "--json", "--out", str(tmp_path / "again")])
    assert json.loads(capsys.readouterr().out)["rms_mm"] == summary["rms_mm"]["worst"]


def test_each_failed_sample_is_printed_as_one_command(sine, tmp_path, capsys, quickly):
    summary = swept(tmp_path, "sweep", "sine", "--samples", "30", "--seed", "4", "--tuning", "paper")
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if line.startswith("hil run")] == [e["replay"] for e in summary["failed"]]
    assert without_wall_time(tmp_path) == without_wall_time(sine)


def test_json_is_all_that_is_printed_if_asked_for(tmp_path, capsys, quickly):
    summary = swept(tmp_path, *SHORT, "--json")
    assert json.loads(capsys.readouterr().out) == summary


def test_the_corners_are_all_played_and_have_no_intervals(tmp_path, quickly):
    box = tmp_path / "box.toml"
    box.write_text("mass = [0.5, 1.5]\ndelay_periods = [1, 3]\n")
    summary = swept(tmp_path / "out", *SHORT[:4], "--corners", "--box", str(box))
    assert summary["samples"] == 4
    assert summary["design"] == "corners"
    assert summary["rms_mm"]["median_low"] is None
    assert summary["failure_share"]["high"] is None
    assert {(row["mass"], row["delay_periods"]) for row in rows(tmp_path / "out")} == {
        ("0.5", "1"),
        ("0.5", "3"),
        ("1.5", "1"),
        ("1.5", "3"),
    }


def test_of_several_scenarios_the_worst_counts(tmp_path, quickly):
    summary = swept(tmp_path, "sweep", "sine", "full_stroke", "--duration", "1.5", "--samples", "5")
    rms_mm = np.array([float(row["rms_mm"]) for row in rows(tmp_path)]).reshape(5, 2)
    assert summary["rms_mm"]["worst"] == rms_mm.max()
    assert summary["rms_mm"]["median"] == np.median(rms_mm.max(axis=1))


def test_the_scenarios_machine_is_the_base_of_the_box(tmp_path, quickly):
    scenario = tmp_path / "mine.toml"
    scenario.write_text('title = "t"\nreference = "sine"\nduration_s = 0.2\n[machine]\nleak = 2.0\n')
    box = tmp_path / "box.toml"
    box.write_text("mass = [0.5, 1.5]\n")
    swept(tmp_path / "out", "sweep", str(scenario), "--box", str(box), "--samples", "3")
    assert {row["leak"] for row in rows(tmp_path / "out")} == {"2.0"}


def test_every_axis_of_the_picture_has_a_unit_where_there_is_one():
    assert {key: axis_label(key) for key in load_box().ranges} == {
        "mass": "moving mass / times nominal",
        "bulk_modulus": "oil's bulk modulus / times nominal",
        "leak": "pumps' leak / times nominal",
        "efficiency": "pumps' efficiency",
        "motor_time_constant_s": "motor's time constant / s",
        "motor_acceleration_rad_s2": "motor's largest acceleration / (rad/s²)",
        "position_lsb_um": "sensor's resolution / µm",
        "delay_periods": "drive's delay / periods",
    }


def test_what_is_not_a_number_is_a_failure():
    figures = np.full((3, 1, len(FIGURES)), 0.1)
    figures[1] = np.nan
    sweep = Sweep(
        names=("sine",),
        scenarios=(load_scenario("sine"),),
        duration_s=None,
        tuning=chosen_tuning(),
        controller="adrc",
        box=load_box(),
        design="latin hypercube",
        seed=0,
        machines=(Machine(),) * 3,
    )
    summary = sweep.summary(figures)
    assert failed(figures[:, 0, 0]).tolist() == [False, True, False]
    assert summary["failures"] == 1
    assert summary["worst"]["sample"] == 1
    assert summary["rms_mm"]["worst"] is None
    assert summary["rms_mm"]["median"] == 0.1
    json.dumps(summary, allow_nan=False)


# nobody but the inputs decides


def test_any_number_of_workers_gives_the_same_files(tmp_path, quickly):
    for workers in ("1", "3"):
        swept(tmp_path / workers, *SHORT, "--workers", workers)
    assert without_wall_time(tmp_path / "1") == without_wall_time(tmp_path / "3")


def test_another_seed_gives_other_samples(tmp_path, quickly):
    summaries = [swept(tmp_path / seed, *SHORT, "--seed", seed) for seed in "12"]
    assert summaries[0]["results_sha256"] != summaries[1]["results_sha256"]


def test_a_dask_cluster_gives_the_same_files(tmp_path, quickly):
    distributed = pytest.importorskip("distributed")
    swept(tmp_path / "here", *SHORT)
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        memory_limit=None,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
    ) as cluster:
        assert cluster.scheduler_address.startswith("tcp://127.0.0.1:")
        swept(tmp_path / "cluster", *SHORT, "--cluster", cluster.scheduler_address)
    assert without_wall_time(tmp_path / "cluster") == without_wall_time(tmp_path / "here")


# the check of a box


def test_the_box_check_has_a_row_for_each_machine_and_a_column_for_each_of_four_runs():
    """The tuning of the paper fails with soft oil, and not on the nominal machine."""
    machines = [Machine(), Machine(mass=1.5, bulk_modulus=0.3, position_lsb_um=10, delay_periods=3)]
    calibration = chosen_tuning("paper").calibration
    rms_mm = box_rms_mm(calibration, machines)
    assert rms_mm.shape == (2, len(BOX_RUNS))
    assert failed(rms_mm).any(axis=1).tolist() == [False, True]
    scenarios = [load_scenario(name) for name in BOX_RUNS]
    with all_cores(2) as cores:
        figures = figures_of(calibration, scenarios, machines, cores)
        assert np.array_equal(box_rms_mm(calibration, machines, executor=cores), figures[..., 0])


# how it ends


def test_ctrl_c_ends_it_with_all_workers_and_leaves_nothing(tmp_path):
    out = tmp_path / "out"
    with sweeping(out) as sweep:
        workers = children(sweep.pid)
        os.kill(sweep.pid, signal.SIGINT)
        assert said_by(sweep, out).startswith("hil: interrupted after")
        assert sweep.exitcode == 130
    wait_until(lambda: not any(map(alive, workers)), "no worker is left")
    assert not out.exists()


def test_a_worker_that_is_killed_ends_it_with_one_line(tmp_path):
    out = tmp_path / "out"
    with sweeping(out) as sweep:
        os.kill(children(sweep.pid)[0], signal.SIGKILL)
        assert said_by(sweep, out).startswith("hil: a worker process was lost")
        assert sweep.exitcode == 3
    assert not out.exists()


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    with sweeping(tmp_path / "out") as sweep:
        workers = children(sweep.pid)
    wait_until(lambda: not any(map(alive, workers)), "no worker is left")


# wrong input


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["sinus"], "unknown scenario 'sinus'"),
        (["sine", "--samples", "0"], "--samples must be 1 or more"),
        (["sine", "--seed", "-1"], "--seed 0 or more"),
        (["sine", "--workers", "0"], "--workers is 0, must be 1 or more"),
        (["sine", "--tuning", "best"], "there is no tuning 'best': choose one of paper"),
        (["sine", "--calibration", "none.bin"], "cannot read calibration file none.bin"),
        (["sine", "--calibration", __file__], "magic"),
        (["sine", "--box", "none.toml"], "box: cannot read none.toml"),
        (["sine", "--box", os.devnull], "box: it is empty"),
        (["sine", "--duration", "0"], "duration_s"),
        (["sine", "--max-failures", "-1"], "--max-failures is -1, must be 0 or more"),
        (["sine", "--out", "/proc/nothing"], "cannot write to /proc/nothing"),
    ],
)
def test_wrong_input_is_refused_in_one_line(capsys, tmp_path, arguments, what):
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "out")]
    assert cli.main(["sweep", *arguments, *out]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert what in said.err
    assert not (tmp_path / "out").exists()


def test_scenarios_on_different_machines_are_refused(capsys, tmp_path):
    scenario = tmp_path / "mine.toml"
    scenario.write_text('title = "t"\nreference = "sine"\nduration_s = 0.2\n[machine]\nleak = 2.0\n')
    assert cli.main(["sweep", "sine", str(scenario)]) == 2
    assert "different machines" in capsys.readouterr().err


def test_a_cluster_that_is_not_there(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("hil.study.runs._CLUSTER_TIMEOUT_S", 0.2)
    arguments = [*SHORT, "--cluster", "tcp://127.0.0.1:9", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(
    ("sources", "what"),
    [
        ({}, "has no workers"),
        ({"tcp://127.0.0.1:1": "another"}, "worker tcp://127.0.0.1:1 has other sources of ddh-hil"),
    ],
)
def test_a_cluster_that_would_not_compute_the_same_is_refused(capsys, tmp_path, monkeypatch, sources, what):
    distributed = pytest.importorskip("distributed")
    client = MagicMock()
    client.return_value.run.return_value = sources
    monkeypatch.setattr(distributed, "Client", client)
    arguments = [*SHORT, "--cluster", "tcp://127.0.0.1:2", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert what in line


def test_without_dask_the_cluster_option_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BenchError, match=r"pip install '\.\[cluster\]'"), dask_cluster("tcp://x"):
        pass


def test_the_example_in_the_documentation_runs(capsys):
    page = (Path(__file__).parents[3] / "docs/studies.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (example,) = [block for block in blocks if "box_rms_mm" in block]
    exec(compile(example.replace("samples(20", "samples(2"), "docs/studies.md", "exec"), {})
    assert capsys.readouterr().out.rstrip().endswith("of 2 fail")


def test_the_tuning_in_the_documentation_can_be_played(tmp_path, monkeypatch):
    page = (Path(__file__).parents[3] / "docs/studies.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (example,) = [block for block in blocks if "mine.cal" in block]
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/studies.md", "exec"), {})
    mine = ["--calibration", "mine.cal", "--duration", "0.1"]
    assert cli.main(["run", "sine", "--mode", "inprocess", *mine]) == 0
    assert cli.main(["sweep", "sine", "--samples", "2", *mine]) == 0
    played = json.loads(Path("out/sine/result.json").read_text(encoding="utf-8"))
    assert (played["tuning"], played["controller"]) == ("mine.cal", "scheduled")


def test_the_documentation_shows_the_keys_and_ranges_of_the_built_in_box():
    page = (Path(__file__).parents[3] / "docs/studies.md").read_text(encoding="utf-8")
    shown = {
        key: (float(low), float(high))
        for key, low, high in re.findall(r"^\| `(\w+)` \|.*\| ([\d.]+) to ([\d.]+) \|$", page, re.MULTILINE)
    }
    assert shown == dict(load_box().ranges)
