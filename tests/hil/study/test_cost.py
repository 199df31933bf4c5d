"""The bill: figures belong to the images that are committed, and none may rise unseen."""

import json

import pytest

from dbc.node import PERIOD_NS
from firmware_py.chosen_firmware import COST
from firmware_py.emulated.build import BuildError
from firmware_py.emulated.image import MANIFEST, reference_image
from firmware_py.emulated.meter import Meter
from firmware_py.emulated.processors import TARGETS
from hil import cli
from hil.scenario import load_scenario
from hil.study.cost import CONTROLLERS, SCENARIO, calibration_of, jump_inputs, step_costs, summary
from hil.study.cost_command import MOST_PERIODS, rows

FIGURES = json.loads(COST.read_text())["processors"]


@pytest.mark.parametrize("processor", TARGETS)
def test_the_figures_are_those_of_the_committed_image(processor):
    manifest = json.loads(MANIFEST.read_text())["images"][processor]
    assert FIGURES[processor]["image_sha256"] == manifest["sha256"], "run make cost"


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("processor", TARGETS)
def test_no_law_costs_more_than_it_did(processor, controller):
    """Integers in, so that the counts are the same on any machine."""
    jumps = jump_inputs()
    measured = summary(step_costs(processor, reference_image(processor), controller, jumps), jumps)
    before = FIGURES[processor]["controllers"][controller]["step"]["jumps"]
    rise = measured["mean_instructions"] / before["mean_instructions"]
    assert rise <= 1.01, f"{controller} on {processor}: {before} before, {measured} now"
    assert measured == before, "run make cost"


@pytest.mark.parametrize("processor", TARGETS)
def test_no_period_costs_more_than_the_worst_on_record(processor):
    meter = Meter(processor, reference_image(processor), calibration_of("robust ADRC"), 100_000)
    costs = [meter.period(*step).timer for step in jump_inputs(100)]
    assert max(cost.high for cost in costs) <= FIGURES[processor]["worst_period_cycles"]
    assert 0 < meter.stack_bytes <= FIGURES[processor]["stack_bytes"]


def test_adrc_on_a_cortex_m4_takes_no_more_than_900_instructions_on_average():
    assert FIGURES["cortex-m4"]["controllers"]["ADRC"]["step"]["sine"]["mean_instructions"] <= 900


def test_the_whole_period_fits_on_every_processor():
    for processor, target in TARGETS.items():
        cycles_of_a_period = target.clock_mhz * PERIOD_NS * 1e-3
        assert FIGURES[processor]["worst_period_cycles"] < 0.3 * cycles_of_a_period


def test_hil_cost_shows_the_bill(capsys):
    assert cli.main(["cost", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["processors"] == FIGURES
    assert cli.main(["cost", "--clock-mhz", "100"]) == 0
    said = capsys.readouterr().out
    assert "100 MHz" in said
    shown = rows(json.loads(COST.read_text()), 100.0)
    assert [cell for row in shown for cell in row[2:] if cell not in said] == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--measure", "--periods", "0"), "--periods is 0, must be from 1 to 10000"),
        (("--measure", "--periods", "10001"), "--periods is 10001"),
        (("--periods", "100"), "--periods needs --measure"),
        (("--clock-mhz", "0"), "a clock of 0 MHz is not from 1 to 1000"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(capsys, arguments, said):
    assert cli.main(["cost", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_all_of_the_sine_is_the_most_that_is_measured():
    assert load_scenario(SCENARIO).periods == MOST_PERIODS


def test_nothing_is_written_where_a_compiler_is_missing(monkeypatch, capsys):
    def missing(compiler, processor):
        raise BuildError(f"{compiler} for {processor} is not installed")

    monkeypatch.setattr("hil.study.cost.compiler_version", missing)
    before = COST.read_bytes()
    assert cli.main(["cost", "--write"]) == 2
    assert capsys.readouterr().err == "hil: zig for cortex-m0plus is not installed\n"
    assert COST.read_bytes() == before
