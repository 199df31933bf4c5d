"""The paper's evaluation: who takes part, the runs over the bus, and the tables made of them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dbc.contract import Contract
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.tuning import TUNINGS
from hil.measure import METRICS, Trace, left_run, result_of, trace_of
from hil.run.inprocess import run_inprocess
from hil.run.options import DEFAULT_BIT_RATE, Recording, RunOptions
from hil.scenario import controller_of, law_of, load_scenario
from hil.study import paper
from hil.study.box import load_box
from hil.study.disturbance import observer_error, true_disturbance_m_s3
from hil.study.runs import FAILED_RMS_MM
from hil.study.stability import StabilityMap, map_machines, stability_maps
from hil.study.state_space import Validation
from hil.study.sweep import Sweep

_KEPT_COLUMNS = ("time_s", "reference_m", "position_m", "error_m", "load_n")
OBSERVED, TRUE = "eso_disturbance_m_s3", "true_disturbance_m_s3"
PAPER_TUNING = "paper"
SWEPT = "sine"
SAMPLES = 64
DIGITS = 5
"""Significant ones in ``tables.json``."""
_PAPER_LAWS = ("p", "pi", "adrc")
_LABELS = {
    "pi_star": "PI*",
    "pi_ff": "PI+FF",
    "linear": "linear ADRC",
    "robust": "robust ADRC",
}


@dataclass(frozen=True, slots=True)
class Contestant:
    """A controller that takes part: a built-in tuning under one of its laws.

    Attributes
    ----------
    label : str
        Its name in tables and figures.
    tuning : str
        Key of `firmware_py.tuning.TUNINGS`.
    law : str
        One of `hil.scenario.CONTROLLERS`.
    """

    label: str
    tuning: str
    law: str

    @property
    def law_number(self) -> int:
        """Number of the law on the bus."""
        return law_of(self.law)

    @property
    def in_paper(self) -> bool:
        """Whether the paper has figures of it."""
        return self.tuning == PAPER_TUNING


@dataclass(frozen=True, slots=True)
class Run:
    """One scenario under one contestant.

    Attributes
    ----------
    figures : dict
        A number for each of `METRICS`, and why they are not those of tracking, if so.
    trace : dict of ndarray
        What is drawn of it, one row per control period; with the paper's ADRC also the total disturbance that
        it observed and the true one.
    """

    figures: dict[str, Any]
    trace: Trace


@dataclass(frozen=True, slots=True)
class Stability:
    """Linear loops about one operating point, by label.

    Attributes
    ----------
    maps : mapping of StabilityMap
        Over the stroke, with the machines of the heat map.
    corners : mapping of mapping
        `StabilityMap.summary` for all corners of the box.
    """

    maps: Mapping[str, StabilityMap]
    corners: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All that was computed.

    Attributes
    ----------
    taking_part : sequence of Contestant
        The paper's three, and others.
    scenarios : sequence of str
        Some of `hil.study.paper.CASES`.
    runs : mapping of Run
        By scenario and label.
    swept : mapping of mapping
        By label, from `hil.study.sweep.Sweep.summary`.
    stability : mapping of Stability
        By operating point.
    validation : Validation
        Figure 3b.
    """

    taking_part: Sequence[Contestant]
    scenarios: Sequence[str]
    runs: Mapping[tuple[str, str], Run]
    swept: Mapping[str, Mapping[str, Any]]
    stability: Mapping[str, Stability]
    validation: Validation

    def traces(self, scenario: str) -> dict[str, Trace]:
        """Return a scenario's traces by label."""
        return {one.label: self.runs[scenario, one.label].trace for one in self.taking_part}


def contestants() -> tuple[Contestant, ...]:
    """Return the paper's three, then every other built-in tuning under the law that it is named for."""
    papers = (Contestant(law.upper(), PAPER_TUNING, law) for law in _PAPER_LAWS)
    others = (
        Contestant(_LABELS.get(name, name), name, controller_of(tuning.law))
        for name, tuning in TUNINGS.items()
        if name != PAPER_TUNING
    )
    return (*papers, *others)


def play(task: tuple[str, Contestant]) -> Run:
    """Play one scenario under one contestant over the bus, all nodes in this process."""
    name, contestant = task
    contract = Contract.load()
    options = RunOptions(
        scenario=load_scenario(name),
        controller=contestant.law,
        tuning=chosen_tuning(contestant.tuning),
        record_directory=Path(),
    )
    recording = run_inprocess(options)
    trace = trace_of(recording, contract)
    result = result_of(recording, trace, contract, options, "inprocess")
    figures: dict[str, Any] = {metric: result[metric] for metric in METRICS}
    figures["untrue"] = left_run(trace)
    kept = {column: trace[column] for column in _KEPT_COLUMNS}
    if contestant.in_paper and contestant.law == "adrc":
        kept |= {OBSERVED: trace[OBSERVED], TRUE: _true_disturbance(recording, len(trace["time_s"]))}
    return Run(figures, kept)


def _true_disturbance(recording: Recording, periods: int) -> np.ndarray:
    assert recording.plant is not None
    played = recording.plant["time_ns"] >= recording.start_ns
    record = {name: column[played][:periods] for name, column in recording.plant.items()}
    return true_disturbance_m_s3(record, TUNINGS[PAPER_TUNING].adrc)


def sweep_of(contestant: Contestant) -> Sweep:
    """Return the small sweep that a contestant is put through."""
    box = load_box()
    return Sweep(
        names=(SWEPT,),
        scenarios=(load_scenario(SWEPT),),
        duration_s=None,
        tuning=chosen_tuning(contestant.tuning),
        controller=contestant.law,
        box=box,
        design="latin hypercube",
        seed=0,
        machines=tuple(box.samples(SAMPLES)),
    )


def stability_of(taking_part: Sequence[Contestant], point: str) -> Stability:
    """Return the linear loops of all contestants about one of `hil.study.linear.OPERATING_POINTS`."""
    tunings = {one.label: (TUNINGS[one.tuning], one.law_number) for one in taking_part}
    corners = stability_maps(tunings, load_box().corners(), point=point)
    return Stability(
        maps=stability_maps(tunings, map_machines(), point=point),
        corners={label: one.summary() for label, one in corners.items()},
    )


def tables_of(evaluation: Evaluation) -> dict[str, Any]:
    """Return all figures of the evaluation, as written to ``tables.json``, with `DIGITS` digits."""
    taking_part, runs = evaluation.taking_part, evaluation.runs
    scenario_tables = {name: _scenario_table(name, evaluation) for name in evaluation.scenarios}
    best = [label for table in scenario_tables.values() for row in table["best"].values() for label in row]
    tables = {
        "paper": f"{paper.PUBLISHED}: {paper.TITLE}",
        "conditions": {"bit_rate": DEFAULT_BIT_RATE, "mode": "inprocess"},
        "contestants": {
            one.label: {
                "tuning": one.tuning,
                "law": one.law,
                "in_paper": one.in_paper,
                "fitted": paper.FITTED_GAINS.get(one.law, "") if one.in_paper else "",
            }
            for one in taking_part
        },
        "scenarios": scenario_tables,
        "adrc_ahead_counts": {
            one.label: sum(
                table["ours"]["ADRC"]["rms_mm"] < table["ours"][one.label]["rms_mm"]
                for table in scenario_tables.values()
            )
            for one in taking_part
            if one.label != "ADRC"
        },
        "best_counts": {one.label: best.count(one.label) for one in taking_part},
        "load_effect_percent": {
            name: _load_effect(runs, name, loaded)
            for name, loaded in paper.WITH_LOAD.items()
            if {name, loaded} <= scenario_tables.keys()
        },
        "robustness": {
            "scenario": SWEPT,
            "samples": SAMPLES,
            "box": {key: list(ends) for key, ends in load_box().ranges.items()},
            "failed_above_mm": FAILED_RMS_MM,
            "contestants": {
                label: {key: summary[key] for key in ("failures", "rms_mm", "chatter_rpm_per_period")}
                for label, summary in evaluation.swept.items()
            },
        },
        "stability": {
            point: {
                label: {"nominal_and_corners": one.summary(), "box": stability.corners[label]}
                for label, one in stability.maps.items()
            }
            for point, stability in evaluation.stability.items()
        },
        "state_space": evaluation.validation.figures(),
    }
    return dict(_shortened(tables))


def _shortened(value: Any) -> Any:
    """Return nested figures with `DIGITS` significant digits."""
    if isinstance(value, Mapping):
        return {key: _shortened(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_shortened(inner) for inner in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _scenario_table(name: str, evaluation: Evaluation) -> dict[str, Any]:
    case, scenario = paper.CASES[name], load_scenario(name)
    adrc = evaluation.traces(name)["ADRC"]
    ours = {one.label: evaluation.runs[name, one.label].figures for one in evaluation.taking_part}
    return {
        "title": case.title,
        "table": case.table,
        "figure": case.figure,
        "fitted": case.fitted,
        "paper": scenario.paper,
        "ours": ours,
        "best": {metric: _best({label: row[metric] for label, row in ours.items()}) for metric in METRICS},
        "reductions_percent": {
            metric: {
                rival: {
                    "stated": stated,
                    "from_its_table": _reduction(
                        scenario.paper["adrc"][metric], scenario.paper[rival][metric]
                    ),
                    "ours": _reduction(ours["ADRC"][metric], ours[rival.upper()][metric]),
                }
                for rival, stated in rivals.items()
            }
            for metric, rivals in case.stated_percent.items()
        },
        "disturbance": asdict(observer_error(adrc[OBSERVED], adrc[TRUE])),
    }


def _best(values: dict[str, float]) -> list[str]:
    """Return who has the smallest value, several if they are equal."""
    smallest = min(values.values())
    return [label for label, value in values.items() if value == smallest]


def _reduction(adrc: float, rival: float) -> float:
    return 100.0 * (1.0 - adrc / rival)


def _load_effect(runs: Mapping[tuple[str, str], Run], free: str, loaded: str) -> dict[str, dict[str, float]]:
    """Return by how many percent the load changes the RMS error, in the paper and here."""
    papers = {name: load_scenario(name).paper for name in (free, loaded)}
    effects = {}
    for law in _PAPER_LAWS:
        theirs = papers[loaded][law]["rms_mm"] / papers[free][law]["rms_mm"]
        ours = runs[loaded, law.upper()].figures["rms_mm"] / runs[free, law.upper()].figures["rms_mm"]
        effects[law] = {"paper": 100.0 * (theirs - 1.0), "ours": 100.0 * (ours - 1.0)}
    return effects
