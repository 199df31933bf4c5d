"""hil tune: a seeded search within limits, never worse than its start; it writes what the bench takes."""

import tomllib
from dataclasses import asdict

import numpy as np
import pytest

from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS, PiTuning, Tuning
from hil.cli import main
from hil.run.options import BenchError
from hil.study.box import load_box
from hil.study.runs import all_cores
from hil.study.tune import GAINS, SCENARIOS, Search, SearchStoppedError, gains_toml, machines_of

BOX = load_box()
SLOW = Tuning(law=k.LAW_P, p=PiTuning(1_000.0))


def searched(evaluations, workers=1, start=SLOW, max_ms=2.0, progress=lambda search: None, seed=1):
    with all_cores(workers) as executor:
        search = Search(start, machines_of(BOX, 2, 7), max_ms, executor)
        search.run(evaluations, seed, progress)
    return search


def test_half_of_the_machines_are_corners_and_seeds_choose_them():
    machines = machines_of(BOX, 5, 3)
    corners = BOX.corners()
    assert len(machines) == 5
    assert sum(machine in corners for machine in machines) == 2
    assert machines == machines_of(BOX, 5, 3)
    assert machines != machines_of(BOX, 5, 4)


def test_every_law_has_gains_that_exist():
    assert set(GAINS) == set(range(k.LAW_P, k.LAW_SCHEDULED + 1))
    for parts in GAINS.values():
        for part, names in parts.items():
            assert set(names) <= asdict(Tuning())[part].keys()


def test_the_best_is_better_than_a_poor_start_and_keeps_the_limits():
    search = searched(evaluations=8)
    assert search.evaluations <= 8
    assert search.started.within_limits
    assert search.best.cost < search.started.cost
    assert np.all(search.best.worst_mm < search.started.worst_mm)
    assert search.best.spectral_radius < 1.0
    assert search.best.ms <= 2.0
    assert search.best.tuning.p.kp_rad_s_per_m > 1_000.0


def test_equal_seeds_give_equal_tunings_whatever_the_number_of_processes():
    one, two = searched(4, workers=1), searched(4, workers=2)
    assert one.best.tuning == two.best.tuning
    assert one.best.cost == two.best.cost


def test_an_unstable_candidate_is_not_played():
    with all_cores(1) as executor:
        search = Search(TUNINGS["paper"], machines_of(BOX, 2, 7), 2.0, executor)
    assert search.started.spectral_radius > 1.0
    assert search.started.worst_mm is None


def test_a_search_that_is_stopped_keeps_the_best_so_far():
    def stop(search):
        raise SearchStoppedError

    search = searched(100, progress=stop)
    assert search.evaluations == 1
    assert search.best.within_limits


@pytest.mark.parametrize("max_ms", [1.0, 0.5, float("nan")])
def test_ms_of_1_is_out_of_reach_and_said_so_at_once(max_ms):
    with pytest.raises(BenchError, match=r"Ms <= \S+ is out of reach") as caught:
        searched(1, max_ms=max_ms)
    assert "\n" not in str(caught.value)


def test_limits_that_no_candidate_kept_are_said_so_in_one_line():
    with pytest.raises(BenchError, match="no tuning within the limits in 2 evaluations") as caught:
        searched(2, start=TUNINGS["robust"], max_ms=1.01)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", TUNINGS)
def test_the_gains_file_says_all_gains(name):
    table = tomllib.loads(gains_toml(TUNINGS[name], ["made by hand"]))
    assert table == asdict(TUNINGS[name])


def test_the_block_is_what_the_bench_takes(tmp_path, capsys):
    file = tmp_path / "new" / "p.cal"
    options = ["--tuning", "robust", "--samples", "2", "--seed", "3", "--evaluations", "1", "--workers", "1"]
    code = main(["tune", *options, "--out", str(file)])
    shown = capsys.readouterr()
    assert code == 0
    assert chosen_tuning(file=file).calibration.law == k.LAW_SCHEDULED
    assert all(name in shown.out for name in SCENARIOS)
    assert "hil tune --tuning robust" in file.with_suffix(".toml").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--samples", "1"], "--samples is 1, must be 2 or more"),
        (["--evaluations", "0"], "--evaluations is 0, must be 1 or more"),
        (["--seed", "-1"], "--seed is -1, must be 0 or more"),
        (["--max-ms", "1"], "Ms <= 1 is out of reach"),
        (["--out", "x.toml"], "the block needs another suffix"),
    ],
)
def test_wrong_input_is_one_line(options, message, capsys):
    assert main(["tune", "--samples", "2", *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
