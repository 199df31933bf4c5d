"""Minimax tuning: the worst errors over machines of a box made small, within limits of stability and Ms.

A candidate is judged in two steps. The linear loop (`hil.study.linear`) must be stable with every machine, at
every position and about every operating point, and the nominal one must keep its sensitivity peak; one that
does not is not played. The others are played with the kernel itself, and their cost is the largest of
their errors in relation to those of the start.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from firmware_py.kernel import layout as k
from firmware_py.tuning import Tuning, TuningError
from hil.run.options import BenchError
from hil.scenario import load_scenario
from hil.study.box import Box
from hil.study.linear import (
    OPERATING_POINTS,
    StateSpace,
    closed_loop,
    controller_model,
    linear_loop,
    plant_model,
)
from hil.study.runs import FAILED_RMS_MM, figures_of
from plant_sim.machine import Machine

SCENARIOS = ("sine", "lift_lower_load", "full_stroke")
"""What candidates are played on; `sine_load` adds nothing to these."""

POSITIONS_M = np.array([0.3, 10, 60, 150, 250, 340, 395]) * 1e-3
MS_POINTS = ("shut", "held")

GAINS: dict[int, dict[str, tuple[str, ...]]] = {
    k.LAW_P: {"p": ("kp_rad_s_per_m",)},
    k.LAW_PI: {"pi": ("kp_rad_s_per_m", "ki_rad_s2_per_m")},
    k.LAW_ADRC: {"adrc": ("omega_o_rad_s", "omega_c_rad_s", "b0_m_s2_per_rad", "a1n_per_s2")},
    k.LAW_PI_FF: {
        "pi": ("kp_rad_s_per_m", "ki_rad_s2_per_m"),
        "front_end": ("extend_rad_per_m", "retract_rad_per_m"),
        "command_filter": ("time_constant_s",),
    },
    k.LAW_SCHEDULED: {
        "scheduled": (
            "b0_m_s2_per_rad",
            "beta1_per_s",
            "beta2_per_s2",
            "beta3_per_s3",
            "omega_d_rad_s",
            "k1_rad_s_per_m",
            "k2_rad_per_m",
            "k3_rad_s2_per_m",
            "k3_soft_rad_s2_per_m",
            "end_a_m",
            "rod_side_weight",
        ),
        "front_end": ("extend_rad_per_m", "retract_rad_per_m", "lead_s"),
        "command_filter": ("time_constant_s",),
    },
}
"""What is varied of each law's tuning, each by a factor."""

_LARGEST_FACTOR = 3.0
_FIRST_STEP = 0.05
_UNPLAYED_COST = 1e3
_MEAN_WEIGHT = 0.1


@dataclass(frozen=True, slots=True)
class Candidate:
    """A tuning and what is known of it.

    Attributes
    ----------
    spectral_radius : float
        Largest over machines, positions and operating points.
    ms : float
        Largest of the nominal machine over positions, shut and held; infinite where unstable.
    nominal_mm, worst_mm : ndarray or None
        RMS error by scenario, of the nominal machine and the worst over all; None if it was not played.
    cost : float
        What is made small.
    """

    tuning: Tuning
    spectral_radius: float
    ms: float
    nominal_mm: np.ndarray | None
    worst_mm: np.ndarray | None
    cost: float

    @property
    def within_limits(self) -> bool:
        """Whether it was stable and kept Ms, and so was played."""
        return self.worst_mm is not None


class SearchStoppedError(Exception):
    """Raised by the progress callback to end a search early."""


class Search:
    """A search from a start.

    Parameters
    ----------
    start : Tuning
        Its law is tuned; whatever `GAINS` does not name is kept.
    machines : sequence of Machine
        What the law has to hold on, the nominal machine besides.
    max_ms : float
        Largest sensitivity peak allowed of the nominal machine.
    executor : Executor
        Where to play, see `hil.study.runs.all_cores`.

    Attributes
    ----------
    started : Candidate
        The start.
    best : Candidate
        The best so far; the start if nothing within the limits was found.
    evaluations : int
        Candidates judged.
    """

    def __init__(self, start: Tuning, machines: Sequence[Machine], max_ms: float, executor: Executor) -> None:
        if not max_ms > 1.0:
            raise BenchError(
                f"Ms <= {max_ms:g} is out of reach: a loop with delay has Ms above 1; allow 1.3 or more"
            )
        self._start, self._max_ms, self._executor = start, max_ms, executor
        self._machines = [Machine(), *machines]
        self._scenarios = [load_scenario(name) for name in SCENARIOS]
        self._names = [
            (part, name)
            for part, names in GAINS[start.law].items()
            for name in names
            if getattr(getattr(start, part), name) != 0
        ]
        distinct = list(dict.fromkeys(replace(one, position_lsb_um=1) for one in self._machines))
        try:
            self._plants = _stacked(distinct, tuple(OPERATING_POINTS))
        except (ValueError, np.linalg.LinAlgError) as error:
            raise BenchError(f"a machine of the box cannot hold its load ({error}): narrow it") from error
        self._nominal_plants = _stacked([Machine()], MS_POINTS)
        self._scale_mm: np.ndarray | None = None
        self.evaluations = 0
        self.started = self.best = self._judged(start)

    def run(self, evaluations: int, seed: int, progress: Callable[["Search"], None]) -> None:
        """Search by Nelder and Mead's simplex, from the start and `evaluations` candidates on.

        Parameters
        ----------
        evaluations : int
            Candidates to judge at most.
        seed : int
            Of the directions of the first simplex.
        progress : callable
            Told after each candidate; may raise `SearchStoppedError`.

        Raises
        ------
        BenchError
            If no candidate, the start included, keeps the limits.
        """
        count = len(self._names)
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], count)
        simplex = np.vstack([np.zeros(count), np.diag(_FIRST_STEP * signs)])
        least = self.started

        def cost(logarithms: np.ndarray) -> float:
            nonlocal least
            if not logarithms.any():  # the simplex begins with the start
                return self.started.cost
            candidate = self._judged(self._tuning(logarithms))
            self.evaluations += 1
            if candidate.cost < self.best.cost:
                self.best = candidate
            least = min(least, candidate, key=lambda one: (one.ms, one.spectral_radius))
            progress(self)
            return candidate.cost

        bound = math.log(_LARGEST_FACTOR)
        with suppress(SearchStoppedError):
            minimize(
                cost,
                np.zeros(count),
                method="Nelder-Mead",
                bounds=[(-bound, bound)] * count,
                options={
                    "initial_simplex": simplex,
                    "maxfev": evaluations + 1,
                    "maxiter": evaluations + 1,
                    "adaptive": True,
                    "xatol": 1e-4,
                    "fatol": 1e-4,
                },
            )
        if not self.best.within_limits:
            reached = f"least Ms {least.ms:.2f}" if math.isfinite(least.ms) else "none was stable"
            raise BenchError(
                f"no tuning within the limits in {self.evaluations} evaluations ({reached}, "
                f"limit {self._max_ms:g}): allow a larger --max-ms, more --evaluations, or start elsewhere"
            )

    def _tuning(self, logarithms: np.ndarray) -> Tuning:
        tuning = self._start
        for (part, name), factor in zip(self._names, np.exp(logarithms).tolist(), strict=True):
            gains = getattr(tuning, part)
            changed = replace(gains, **{name: getattr(gains, name) * factor})
            tuning = replace(tuning, **{part: changed})
        return tuning

    def _judged(self, tuning: Tuning) -> Candidate:
        """Return a candidate; the first one that is played sets the scale of the costs."""
        controllers = StateSpace.stacked([controller_model(tuning, x) for x in POSITIONS_M.tolist()])
        eigenvalues = np.linalg.eigvals(closed_loop(self._plants, controllers))
        radius = float(np.abs(eigenvalues).max())
        ms = float(linear_loop(self._nominal_plants, controllers).ms.max())
        excess = max(0.0, radius - 1.0) * 1e3 + min(max(0.0, ms - self._max_ms), 1e2)
        try:
            calibration = tuning.calibration()
        except TuningError:
            excess = math.inf
        if radius >= 1.0 or excess > 0.0:
            return Candidate(tuning, radius, ms, None, None, _UNPLAYED_COST + excess)
        figures = figures_of(calibration, self._scenarios, self._machines, self._executor)
        rms_mm = np.nan_to_num(figures[..., 0], nan=math.inf)
        errors_mm = np.stack([rms_mm[0], rms_mm.max(axis=0)])
        if self._scale_mm is None:
            self._scale_mm = np.minimum(errors_mm, FAILED_RMS_MM)
        ratios = np.minimum(errors_mm / self._scale_mm, 1e2)
        cost = float(ratios.max() + _MEAN_WEIGHT * ratios.mean())
        return Candidate(tuning, radius, ms, errors_mm[0], errors_mm[1], cost)


def machines_of(box: Box, count: int, seed: int) -> list[Machine]:
    """Return seeded machines of a box, half of them corners (rounded down), the others samples."""
    corners = box.corners()
    chosen = np.random.default_rng(seed).permutation(len(corners))[: count // 2]
    return [corners[index] for index in chosen.tolist()] + box.samples(count - len(chosen), seed)


def gains_toml(tuning: Tuning, about: Sequence[str]) -> str:
    """Return all physical gains of a tuning as readable TOML, `about` as comments before them."""
    lines = [f"# {line}" for line in about]
    values: dict[str, Any] = asdict(tuning)
    lines += [f"{name} = {value!r}" for name, value in values.items() if not isinstance(value, dict)]
    for part, gains in values.items():
        if isinstance(gains, dict):
            lines += ["", f"[{part}]", *(f"{name} = {value!r}" for name, value in gains.items())]
    return "\n".join(lines) + "\n"


def _stacked(machines: Sequence[Machine], points: Sequence[str]) -> StateSpace:
    """Return plants along the positions, a row for each machine and operating point."""
    return StateSpace.stacked(
        [
            StateSpace.stacked([plant_model(machine, x, point) for x in POSITIONS_M.tolist()])
            for machine in machines
            for point in points
        ]
    )
