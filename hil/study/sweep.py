"""A sweep: scenarios on many machines of a box, what came of them, and how to play any of them again."""

import csv
import hashlib
import shlex
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.chosen_tuning import ChosenTuning
from hil.measure import METRICS
from hil.picture import BLUE, GREY, RED
from hil.scenario import Scenario, law_of
from hil.study.box import WHOLE, Box
from hil.study.runs import FAILED_RMS_MM, FIGURES, failed
from plant_sim.machine import Machine

CONFIDENCE = 0.95
CORNERS, SAMPLES = "corners", "latin hypercube"
"""Designs of a sweep."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """What is played on which machines.

    Attributes
    ----------
    names : tuple of str
        The scenarios as the command line takes them.
    scenarios : tuple of Scenario
    duration_s : float or None
        Length they were cut to, s.
    tuning : ChosenTuning
    controller : str
        Control law, one of `hil.scenario.CONTROLLERS`.
    box : Box
    design : str
        `CORNERS` or `SAMPLES`.
    seed : int or None
        Of the hypercube.
    machines : tuple of Machine
        The samples, or the corners.
    """

    names: tuple[str, ...]
    scenarios: tuple[Scenario, ...]
    duration_s: float | None
    tuning: ChosenTuning
    controller: str
    box: Box
    design: str
    seed: int | None
    machines: tuple[Machine, ...]

    @property
    def kind(self) -> str:
        """What the machines are called."""
        return self.design if self.design == CORNERS else "samples"

    @property
    def law(self) -> int:
        """Number of the control law."""
        return law_of(self.controller)

    def replay(self, sample: int, scenario: int) -> str:
        """Return the command that plays one run again, over the bus."""
        command = ["hil", "run", self.names[scenario], "--mode", "inprocess", "--controller", self.controller]
        command += ["--calibration" if self.tuning.is_file else "--tuning", self.tuning.name]
        if self.duration_s is not None:
            command += ["--duration", repr(self.duration_s)]
        return shlex.join([*command, "--machine", self.machines[sample].text])

    def summary(self, figures: np.ndarray) -> dict[str, Any]:
        """Return what came of it, as written to ``sweep.json``.

        Parameters
        ----------
        figures : ndarray, shape (machines, scenarios, 3)
            From `hil.study.runs.figures_of`.

        Returns
        -------
        summary : dict
            A sample's figures are the worst of its scenarios. Intervals hold for independent samples, which
            those of a Latin hypercube are not quite: it errs on the safe side. Corners have none.
        """
        fails = failed(figures[..., 0])
        worst = np.where(np.isfinite(figures), figures, np.inf).max(axis=1)
        ordered = np.argsort(-worst[:, 0], kind="stable").tolist()
        sampled = self.design != CORNERS
        block = self.tuning.calibration.to_bytes()
        return {
            "scenarios": list(self.names),
            "duration_s": self.duration_s,
            "controller": self.controller,
            "tuning": self.tuning.name,
            "calibration_sha256": hashlib.sha256(block).hexdigest(),
            "box": {key: list(ends) for key, ends in self.box.ranges.items()},
            "design": self.design,
            "seed": self.seed,
            "samples": len(self.machines),
            "failures": int(fails.any(axis=1).sum()),
            "failure_share": _share(int(fails.any(axis=1).sum()), len(self.machines), sampled),
            **{name: _spread(worst[:, index], sampled) for index, name in enumerate(FIGURES)},
            "worst": self._run(figures, ordered[0]),
            "failed": [self._run(figures, sample) for sample in np.flatnonzero(fails.any(axis=1)).tolist()],
            "results_sha256": hashlib.sha256(figures.astype("<f8").tobytes()).hexdigest(),
        }

    def _run(self, figures: np.ndarray, sample: int) -> dict[str, Any]:
        """Return the scenario in which a sample did worst, and how to play it again."""
        rms_mm = figures[sample, :, 0]
        scenario = int(np.argmax(np.where(np.isfinite(rms_mm), rms_mm, np.inf)))
        return {
            "sample": sample,
            "scenario": self.names[scenario],
            **{name: _finite(value) for name, value in zip(FIGURES, figures[sample, scenario], strict=True)},
            "machine": asdict(self.machines[sample]),
            "replay": self.replay(sample, scenario),
        }


def _share(count: int, of: int, sampled: bool) -> dict[str, float | None]:
    """Return a share with its Clopper-Pearson interval."""
    from scipy.stats import binomtest

    interval = binomtest(count, of).proportion_ci(CONFIDENCE, method="exact") if sampled else (None, None)
    return {"value": count / of, "low": interval[0], "high": interval[1]}


def _spread(values: np.ndarray, sampled: bool) -> dict[str, float | None]:
    """Return median with its interval from order statistics, 95th percentile and worst of all samples."""
    from scipy.stats import quantile_test

    interval = quantile_test(values, p=0.5).confidence_interval(CONFIDENCE) if sampled else (np.nan, np.nan)
    spread = {
        "median": np.median(values),
        "median_low": interval[0],
        "median_high": interval[1],
        "p95": np.quantile(values, 0.95, method="higher"),  # no mean with an infinity
        "worst": values.max(),
    }
    return {name: _finite(value) for name, value in spread.items()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def write_samples(path: Path, sweep: Sweep, figures: np.ndarray) -> None:
    """Write a row for each run: sample, machine, scenario and figures, in full precision."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["sample", "scenario", *asdict(sweep.machines[0]), *FIGURES, "failed"])
        for sample, machine in enumerate(sweep.machines):
            for name, run in zip(sweep.names, figures[sample].tolist(), strict=True):
                writer.writerow([sample, name, *asdict(machine).values(), *run, int(failed(run[0]))])


def axis_label(key: str) -> str:
    """Return what a key of `plant_sim.machine.Machine` is called on an axis, with its unit."""
    (metadata,) = (item.metadata for item in fields(Machine) if item.name == key)
    called, unit = metadata["called"], metadata["unit"]
    return f"{called} / {f'({unit})' if '/' in unit else unit}" if unit else called


def draw(path: Path, sweep: Sweep, figures: np.ndarray, summary: dict[str, Any]) -> None:
    """Draw the RMS error over each key of the box: what it depends on."""
    import matplotlib  # 0.3 s, which only drawing should cost

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import MaxNLocator

    rms_mm = np.nan_to_num(figures[..., 0], nan=np.inf).max(axis=1)
    fails = failed(rms_mm)
    columns = min(4, len(sweep.box.ranges))
    rows = -(-len(sweep.box.ranges) // columns)
    picture, axes = pyplot.subplots(
        rows,
        columns,
        figsize=(3.1 * columns, 2.6 * rows + 0.6),
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    picture.suptitle(
        f"{', '.join(sweep.names)} under {sweep.tuning.name} ({sweep.controller}): "
        f"{summary['failures']} of {summary['samples']} {sweep.kind} above {FAILED_RMS_MM:g} mm"
    )
    for axis in axes.flat[len(sweep.box.ranges) :]:
        axis.remove()
    for axis, key in zip(axes.flat, sweep.box.ranges, strict=False):
        values = np.array([getattr(machine, key) for machine in sweep.machines])
        for chosen, colour in ((~fails, BLUE), (fails, RED)):
            axis.plot(values[chosen], rms_mm[chosen], ".", color=colour, ms=4, alpha=0.7)
        axis.axhline(FAILED_RMS_MM, color=GREY, lw=0.9, ls="--")
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_xlabel(axis_label(key))
        axis.xaxis.set_major_locator(MaxNLocator(5, integer=key in WHOLE))
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel(METRICS["rms_mm"][0])
    picture.savefig(path, dpi=110)
    pyplot.close(picture)
