"""`hil reproduce`: one report, whose figures are those of runs and whose marks are honest."""

import json
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import redirect_stdout
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, alive, children, played, wait_until
from rich.console import Console

from firmware_py import tuning
from hil import cli
from hil.study import paper
from hil.study.evaluation import (
    DIGITS,
    METRICS,
    OBSERVED,
    TRUE,
    Contestant,
    Evaluation,
    Run,
    contestants,
    play,
    tables_of,
)
from hil.study.figures import save, tracking
from hil.study.linear import OPERATING_POINTS
from hil.study.report_page import page
from hil.study.reproduce import summary
from hil.study.state_space import Validation

ROOT = Path(__file__).parents[2]
PICTURES = {f"figure_{number}" for number in ("3b", 5, 6, 7, 8)} | {
    "comparison",
    "rivals",
    "stability",
}


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of an evaluation, into which others had put something, and what it printed."""
    folder = tmp_path_factory.mktemp("out")
    for name in ("report.html", "notes.txt"):
        (folder / name).write_text("old")
    printed = StringIO()
    with redirect_stdout(printed):
        assert cli.main(["reproduce", "--json", "--out", str(folder)]) == 0
    return folder, printed.getvalue()


@pytest.fixture(scope="module")
def out(evaluated: tuple[Path, str]) -> Path:
    return evaluated[0]


@pytest.fixture(scope="module")
def tables(out: Path) -> dict[str, Any]:
    return json.loads((out / "tables.json").read_text())


@pytest.fixture(scope="module")
def report(out: Path) -> str:
    return (out / "report.html").read_text()


def test_the_folder_holds_report_tables_and_every_picture_twice(out):
    pictures = {name + suffix for name in PICTURES for suffix in (".svg", ".png")}
    assert {file.name for file in out.iterdir()} == {"report.html", "tables.json", "notes.txt"} | pictures
    for name in PICTURES:
        assert ET.parse(out / f"{name}.svg").getroot().tag.endswith("svg")
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


# tables.json


def test_the_last_evaluation_in_docs_is_what_is_evaluated_now(tables):
    """Figures may differ as floating point does from one processor to another, all else is the same."""
    committed = json.loads((ROOT / "docs" / "tables.json").read_text())
    assert list(differences(tables, committed)) == [], "run `make figures`"


def differences(one: Any, other: Any, path: str = "") -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict) and list(one) == list(other):
        for key in one:
            yield from differences(one[key], other[key], f"{path}/{key}")
    elif isinstance(one, float) and isinstance(other, float):
        if one != pytest.approx(other, rel=0.02, abs=0.01):
            yield f"{path}: {one} is not {other}"
    elif one != other:
        yield f"{path}: {one} is not {other}"


@pytest.mark.parametrize("scenario", paper.CASES)
def test_figures_are_those_of_a_run_over_the_bus(tables, scenario):
    result = played(scenario).result
    ours = tables["scenarios"][scenario]["ours"]["ADRC"]
    assert ours["untrue"] == ""
    for metric in METRICS:
        assert ours[metric] == pytest.approx(result[metric], rel=1e-4)


def test_everyone_takes_part_and_a_new_tuning_by_itself(tables, monkeypatch):
    assert list(tables["contestants"])[:3] == ["P", "PI", "ADRC"]
    part = {one["tuning"] for one in tables["contestants"].values()}
    assert part == set(tuning.TUNINGS)
    monkeypatch.setitem(tuning.TUNINGS, "new", tuning.TUNINGS["pi_star"])
    assert contestants()[-1] == Contestant("new", "new", "pi")


def test_the_papers_percentages_follow_from_its_tables(tables):
    for scenario in tables["scenarios"].values():
        for rivals in scenario["reductions_percent"].values():
            for reduction in rivals.values():
                assert abs(reduction["stated"] - reduction["from_its_table"]) <= 0.6


def test_our_percentages_follow_from_our_tables(tables):
    scenario = tables["scenarios"]["sine"]
    adrc, pi = (scenario["ours"][label]["rms_mm"] for label in ("ADRC", "PI"))
    ours = scenario["reductions_percent"]["rms_mm"]["pi"]["ours"]
    assert ours == pytest.approx(100 * (1 - adrc / pi), abs=0.05)


def test_the_error_that_falls_under_load_is_the_papers_alone(tables):
    for effects in tables["load_effect_percent"].values():
        assert effects["pi"]["paper"] < 0 < effects["pi"]["ours"]
        assert effects["adrc"]["paper"] < 0 < effects["adrc"]["ours"]


def test_adrc_is_ahead_by_more_than_in_the_paper_as_the_report_says(tables):
    for scenario in tables["scenarios"].values():
        for rivals in scenario["reductions_percent"].values():
            assert all(reduction["ours"] > reduction["from_its_table"] for reduction in rivals.values())


def test_what_was_fitted_is_marked(tables):
    fitted = {label for label, one in tables["contestants"].items() if one["fitted"]}
    assert fitted == {"P", "PI"}
    assert [name for name, one in tables["scenarios"].items() if not one["fitted"]] == ["sine"]


def test_the_observer_is_compared_with_the_truth(tables):
    for scenario in tables["scenarios"].values():
        error = scenario["disturbance"]
        assert 0 < error["delayed_relative"] < error["relative"] < 0.2
        assert 30 <= error["delay_ms"] <= 50


def test_who_is_best_is_best_whoever_it_is():
    made_up = {
        ("sine", label): Run(
            {"rms_mm": rms_mm, "max_mm": 1.0, "chatter_rpm_per_period": 1.0, "untrue": ""},
            {OBSERVED: np.ones(200), TRUE: np.ones(200)},
        )
        for label, rms_mm in {"P": 4.0, "PI": 3.0, "ADRC": 2.0, "rival": 1.0}.items()
    }
    no_validation = Validation(np.empty(0), np.empty(0), {}, {})
    taking_part = (*contestants()[:3], Contestant("rival", "pi_star", "pi"))
    tables = tables_of(Evaluation(taking_part, ["sine"], made_up, {}, {}, no_validation))
    assert tables["scenarios"]["sine"]["best"] == {
        "rms_mm": ["rival"],
        "max_mm": ["P", "PI", "ADRC", "rival"],
        "chatter_rpm_per_period": ["P", "PI", "ADRC", "rival"],
    }
    assert tables["best_counts"] == {"P": 2, "PI": 2, "ADRC": 2, "rival": 3}


@pytest.mark.parametrize("point", OPERATING_POINTS)
def test_stability_is_judged_for_everyone_about_every_point(tables, point):
    assert list(tables["stability"][point]) == list(tables["contestants"])
    for one in tables["stability"][point].values():
        assert [verdict["machines"] for verdict in one.values()] == [27, 256]
        for verdict in one.values():
            assert (verdict["unstable_machines"] > 0) == (verdict["largest_spectral_radius"] >= 1.0)


# the report


class Links(HTMLParser):
    """Collects what a page would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.sources += [value or "" for name, value in attributes if name in ("src", "href", "srcset")]


def test_the_report_needs_no_network(report):
    links = Links(report)
    assert not links.tags & {"script", "link", "iframe", "object"}
    assert len(links.sources) == len(PICTURES)
    assert all(source.startswith("data:image/svg+xml;base64,") for source in links.sources)
    assert not re.search(r"url\(|@import|http", report.split("</style>")[0])


def test_the_report_shows_all_figures_and_marks_the_best(report, tables):
    cells = set(re.findall(r"<td[^>]*>([^<]*)</td>", report))
    best_cells = set(re.findall(r'<td class="best">([^<]*)</td>', report))
    for scenario in tables["scenarios"].values():
        for label, figures in scenario["ours"].items():
            for metric in ("rms_mm", "max_mm"):
                shown = f"{figures[metric]:.3f}"
                assert shown in cells
                assert (label not in scenario["best"][metric]) or shown in best_cells


def test_the_report_says_what_is_not_reproduced(report):
    for said in ("calibration, not", "Figure 3a", "2.193 or 2.183", "fall when a load is added"):
        assert said in report


# one result, whatever the machine does


def test_runs_and_a_picture_made_here_are_those_that_workers_made(tmp_path, out, tables):
    traces = {}
    for one in contestants()[:3]:
        run = play(("sine", one))
        traces[one.label] = run.trace
        ours = tables["scenarios"]["sine"]["ours"][one.label]
        assert {metric: float(f"{run.figures[metric]:.{DIGITS}g}") for metric in METRICS} == {
            metric: ours[metric] for metric in METRICS
        }
    save(tmp_path, "figure_5", tracking(traces))
    for name in ("figure_5.svg", "figure_5.png"):
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes()


# on the screen, at the door and at the end


def test_json_on_standard_output_is_the_file(evaluated):
    folder, printed = evaluated
    assert printed == (folder / "tables.json").read_text()


def test_the_summary_shows_everyone_beside_the_paper(tables):
    console = Console(width=100, file=StringIO())
    console.print(summary(tables))
    said = console.file.getvalue()
    for text in ("ADRC, paper", "0.428 / 1.514", *tables["contestants"], *tables["scenarios"]):
        assert text in said


def test_a_folder_that_cannot_be_is_one_line(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["reproduce", "--out", str(tmp_path / "file")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "choose another --out" in line


def test_help_fits_a_screen(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        cli.main(["reproduce", "--help"])
    assert ended.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """An evaluation that has its workers, into tmp_path/new."""
    process = subprocess.Popen(
        [sys.executable, "-m", "hil", "reproduce", "--out", str(tmp_path / "new")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(lambda: process.poll() is not None or children(process.pid), "there are workers")
        yield process
    finally:
        process.kill()
        process.communicate()


def test_ctrl_c_leaves_nothing(begun, tmp_path):
    workers = children(begun.pid)
    begun.send_signal(signal.SIGINT)
    _, said = begun.communicate(timeout=SAFETY_NET_S)
    assert (begun.returncode, said.splitlines()) == (130, ["hil: interrupted"])
    assert not (tmp_path / "new").exists()
    assert not any(map(alive, workers))


def test_a_lost_worker_is_said_so(begun, tmp_path):
    os.kill(children(begun.pid)[0], signal.SIGKILL)
    _, said = begun.communicate(timeout=SAFETY_NET_S)
    assert begun.returncode == 3
    assert [line for line in said.splitlines() if "worker process was lost" in line]
    assert not (tmp_path / "new").exists()


def test_workers_end_with_a_parent_that_is_killed(begun):
    workers = children(begun.pid)
    begun.kill()
    wait_until(lambda: not any(map(alive, workers)), "the workers have ended")


def test_a_page_without_a_figure_is_refused(tables):
    del tables["scenarios"]["sine"]["ours"]["ADRC"]["rms_mm"]
    with pytest.raises(Exception, match="rms_mm"):
        page(tables, {name: Path(__file__) for name in PICTURES})
