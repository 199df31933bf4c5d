"""Helpers of the controller's tests: the kernel on its two machines, and the closed loop step by step."""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from firmware_py import checked
from firmware_py.calibration import Calibration
from firmware_py.kernel import layout as k
from hil.closed_loop import PERIOD_S, RAD_S_PER_COUNT, SUBSTEPS
from hil.references import setpoint_counts
from hil.scenario import load_scenario
from plant_sim.equilibrium import initial_state
from plant_sim.integrator import advance
from plant_sim.layout import POSITION
from plant_sim.parameters import PlantParameters

Controller = Callable[[int, int], int]
"""Setpoint (0.1 um), position (um) -> target velocity (0.25 rpm)."""


@dataclass(frozen=True)
class Case:
    """Reference and load of a scenario."""

    setpoint: np.ndarray
    load_n: np.ndarray


def make_case(name: str) -> Case:
    scenario = load_scenario(name)
    return Case(setpoint_counts(scenario.reference_m()), scenario.load_n())


CASES = {name: make_case(name) for name in ("sine", "sine_load", "lift_lower", "lift_lower_load")}


class CheckedController:
    """The kernel's source on width-checked integers."""

    def __init__(
        self, modules: dict[str, ModuleType], calibration: Calibration, law: int, position: int
    ) -> None:
        self.calibration = checked.CheckedArray(calibration.words)
        self.state = checked.CheckedArray([0] * k.ST_SIZE)
        self.io = checked.CheckedArray([0] * k.IO_SIZE)
        self._control = modules["control"]
        self.io[k.IO_LAW] = law
        self.io[k.IO_POSITION] = position
        self._control.control_reset(self.calibration, self.state, self.io)

    def step(self, setpoint: int, position: int) -> int:
        self.io[k.IO_SETPOINT] = setpoint
        self.io[k.IO_POSITION] = position
        self._control.control_step(self.calibration, self.state, self.io)
        return int(self.io[k.IO_TARGET_VELOCITY])


def step_through(case: Case, make_controller: Callable[[int], Controller]) -> np.ndarray:
    """Positions x(t_k) of a closed loop run period by period, nominal plant, one period of delay.

    `make_controller` gets the first measured position.
    """
    parameters = PlantParameters()
    plant: Any = initial_state(parameters)
    vector = parameters.vector()
    controller = make_controller(round(plant[POSITION] * 1e6))
    positions = np.empty(case.setpoint.size)
    held = 0
    setpoints = case.setpoint.tolist()
    for tick, load_n in enumerate(case.load_n.tolist()):
        positions[tick] = plant[POSITION]
        measured = int(np.floor(plant[POSITION] * 1e6 + 0.5))
        command = controller(setpoints[tick], measured)
        advance(plant, vector, held * RAD_S_PER_COUNT, load_n, PERIOD_S, SUBSTEPS)
        held = command
    return positions
