"""Fair rivals: gains optimised for the nominal machine under one limit of robustness, Ms <= 2.

The limit holds from 0.3 to 370 mm with both chambers shut, at the gain of pump A while it lifts, η D, and at
that while the load drives it, (2 - η) D. Where a controller really holds the rod (point "held" of
`hil.study.linear`) all of them keep less: see `hil.study.stability`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import NonlinearConstraint, differential_evolution

from firmware_py.kernel import layout as k
from firmware_py.tuning import LINEAR, PiTuning, Tuning
from hil.closed_loop import play_closed_loop
from hil.scenario import load_scenario
from hil.study.linear import StateSpace, controller_model, linear_loop, plant_model
from plant_sim.machine import Machine

MS_LIMIT = 2.0
POSITIONS_M = np.array([0.3, *range(20, 361, 20), 370]) * 1e-3
SCENARIO = "sine"
_HUGE_MS = 1e3
_GENERATIONS = 30
_POPULATION = 10


@dataclass(frozen=True, slots=True)
class Search:
    """What is optimised: a tuning made from named values within bounds."""

    tuning: Callable[[Sequence[float]], Tuning]
    bounds: dict[str, tuple[float, float]]


SEARCHES = {
    "pi_star": Search(
        lambda values: Tuning(law=k.LAW_PI, pi=PiTuning(*values)),
        {"kp_rad_s_per_m": (5e3, 5e4), "ki_rad_s2_per_m": (5e4, 1.5e6)},
    ),
    "linear": Search(
        lambda values: Tuning(
            law=k.LAW_ADRC, adrc=replace(LINEAR, omega_o_rad_s=values[0], omega_c_rad_s=values[1])
        ),
        {"omega_o_rad_s": (30.0, 400.0), "omega_c_rad_s": (20.0, 450.0)},
    ),
}
"""By the rival's name. `linear` is what came out; `pi_star` is a softer one, what comes out cycles."""


def limit_plants() -> StateSpace:
    """Return the plants on which Ms is limited, one beside the other."""
    machine = Machine()
    shut = StateSpace.stacked([plant_model(machine, x, "shut") for x in POSITIONS_M.tolist()])
    driven = replace(shut, a=shut.a.copy())
    driven.a[:, :5, 5:] *= (2.0 - machine.efficiency) / machine.efficiency
    return StateSpace(
        *(np.concatenate([getattr(one, part) for one in (shut, driven)]) for part in ("a", "b", "c", "d"))
    )


def limited_ms(tuning: Tuning, plants: StateSpace) -> float:
    """Return the largest Ms over `limit_plants` of a tuning whose law does not depend on the position."""
    return float(linear_loop(plants, controller_model(tuning, 0.0)).ms.max())


def sine_rms_mm(tuning: Tuning) -> float:
    """Return the RMS error of the nominal machine over the sine without load, mm."""
    return play_closed_loop(load_scenario(SCENARIO), tuning.calibration()).rms_mm


def optimise(name: str, seed: int = 0) -> dict[str, Any]:
    """Search the gains with the smallest error over the sine among those within the limit of Ms.

    Parameters
    ----------
    name : str
        Key of `SEARCHES`.
    seed : int
        Of the differential evolution.

    Returns
    -------
    found : dict
        The values by name, ``rms_mm`` and ``ms``.
    """
    search, plants = SEARCHES[name], limit_plants()

    def robustness(values: Sequence[float]) -> float:
        return 1.0 / min(limited_ms(search.tuning(values), plants), _HUGE_MS)

    result = differential_evolution(
        lambda values: sine_rms_mm(search.tuning(values)),
        list(search.bounds.values()),
        constraints=NonlinearConstraint(robustness, 1.0 / MS_LIMIT, np.inf),
        rng=seed,
        popsize=_POPULATION,
        maxiter=_GENERATIONS,
        polish=False,
        init="sobol",
    )
    values = dict(zip(search.bounds, result.x.tolist(), strict=True))
    return values | {"rms_mm": float(result.fun), "ms": 1.0 / robustness(result.x)}
