"""The closed loop without the bus: kernel and plant in one compiled loop, on the bus run's timing chart."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dbc.jit import njit
from firmware_py.calibration import Calibration
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel.layout import (
    IO_FLAGS,
    IO_LAW,
    IO_POSITION,
    IO_SATURATIONS,
    IO_SETPOINT,
    IO_SIZE,
    IO_TARGET_VELOCITY,
    ST_SIZE,
)
from hil.references import SETPOINT_LSB_M, setpoint_counts
from hil.scenario import Scenario, ScenarioError
from hil.supervisor import BRING_UP_PERIODS
from plant_sim.drive import COUNTS_PER_RPM, RAD_S_PER_COUNT
from plant_sim.equilibrium import initial_state
from plant_sim.integrator import advance
from plant_sim.layout import POSITION
from plant_sim.machine import Machine
from plant_sim.parameters import PlantParameters
from plant_sim.period import PERIOD_S, SUBSTEPS
from plant_sim.sensors import quantised_um

RUNNING_BEFORE_START_PERIODS = 58
"""How long the controller has been in Run when a scenario starts, on a bus at 1 Mbit/s.

It follows from the supervisor's bring-up: tests/hil/study/test_loop_and_bus.py compares.
"""


@njit(
    "void(int32[::1], int32[::1], int32[::1], float64[::1], float64[::1], int32[::1], float64[::1],"
    " int64, int64, int64, int64, float64[::1], int32[::1], int32[::1], int32[:,::1])",
    depends=("firmware_py.compiled", "firmware_py.kernel", "plant_sim"),
)
def _run(  # type: ignore[no-untyped-def]
    calibration,
    state,
    io,
    plant,
    parameters,
    setpoint,
    load,
    position_lsb_um,
    delay_periods,
    hold_periods,
    speed_limit,
    position,
    velocity,
    flags,
    states,
):
    """Fill `position` (m), `velocity` (0.25 rpm), `flags` and `states`, a row for each period."""
    pending = np.zeros(delay_periods, np.int32)
    for tick in range(-hold_periods, setpoint.size):
        k = max(tick, 0)
        position[k] = plant[POSITION]
        io[IO_POSITION] = quantised_um(plant[POSITION], position_lsb_um)
        io[IO_SETPOINT] = setpoint[k]
        if tick == -hold_periods:
            control_reset(calibration, state, io)
        control_step(calibration, state, io)
        velocity[k] = io[IO_TARGET_VELOCITY]
        flags[k] = io[IO_FLAGS]
        states[k] = state
        slot = (tick + hold_periods) % delay_periods
        held = pending[slot]
        pending[slot] = min(max(io[IO_TARGET_VELOCITY], -speed_limit), speed_limit)
        load_n = load[k] if tick >= 0 else 0.0
        advance(plant, parameters, held * RAD_S_PER_COUNT, load_n, PERIOD_S, SUBSTEPS)


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """One row per control period k, at t_k = k ms.

    Attributes
    ----------
    reference_m : ndarray of float64
        r(t_k) as given, rounded to the setpoint's 0.1 um.
    position_m : ndarray of float64
        The plant's unquantised x(t_k).
    command_rpm : ndarray of float64
        Speed commanded from x(t_k) and r(t_k); the drive holds it from t_k + delay on.
    flags : ndarray of int32
        `FLAG_*` of `firmware_py.kernel.layout`.
    states : ndarray of int32, shape (periods, ST_SIZE)
        The kernel's state after the tick, indexed by `ST_*`.
    saturations : int
        States that hit their 32-bit range over the run.
    """

    reference_m: np.ndarray
    position_m: np.ndarray
    command_rpm: np.ndarray
    flags: np.ndarray
    states: np.ndarray
    saturations: int

    @property
    def error_m(self) -> np.ndarray:
        """r(t_k) - x(t_k)."""
        return self.reference_m - self.position_m

    @property
    def rms_mm(self) -> float:
        """RMS of the error over the run."""
        return float(np.sqrt(np.mean((self.error_m * 1e3) ** 2)))

    @property
    def max_mm(self) -> float:
        """Largest error magnitude."""
        return float(np.max(np.abs(self.error_m * 1e3)))

    @property
    def chatter_rpm_per_period(self) -> float:
        """RMS of the first difference of the commanded speed, rpm per period."""
        return float(np.sqrt(np.mean(np.diff(self.command_rpm) ** 2)))


def run_closed_loop(
    calibration: Calibration,
    setpoint: np.ndarray,
    load_n: np.ndarray,
    *,
    law: int | None = None,
    parameters: PlantParameters | None = None,
    position_lsb_um: int = 1,
    delay_periods: int = 1,
    hold_periods: int = 0,
    plant: np.ndarray | None = None,
) -> ClosedLoopRun:
    """Run kernel and plant over a whole reference.

    The command computed from x(t_k) is held over [t_k+delay, t_k+delay+1); before the first one the drive
    is at rest.

    Parameters
    ----------
    calibration : Calibration
    setpoint : ndarray of int32
        Reference at each t_k in 0.1 um.
    load_n : ndarray of float64
        External load over [t_k, t_k+1), N.
    law : int, optional
        Control law, instead of the calibration's default.
    parameters : PlantParameters, optional
        The machine, nominal if not given.
    position_lsb_um : int
        Resolution of the position sensor, um.
    delay_periods : int
        Transport delay, at least 1.
    hold_periods : int
        Periods at the first setpoint, without load, before k = 0.
    plant : ndarray, optional
        State of the plant at the beginning, see `plant_sim.layout`; at rest, retracted, if not given. It is
        advanced in place.
    """
    if setpoint.shape != load_n.shape or delay_periods < 1 or position_lsb_um < 1 or hold_periods < 0:
        raise ValueError("closed loop: setpoint and load differ in length, or an option is out of range")
    parameters = parameters or PlantParameters()
    io: Any = np.zeros(IO_SIZE, np.int32)
    io[IO_LAW] = calibration.law if law is None else law
    position = np.empty(setpoint.size)
    velocity = np.empty(setpoint.size, np.int32)
    flags = np.empty(setpoint.size, np.int32)
    states = np.empty((setpoint.size, ST_SIZE), np.int32)
    _run(
        calibration.array(),
        np.zeros(ST_SIZE, np.int32),
        io,
        initial_state(parameters) if plant is None else plant,
        parameters.vector(),
        np.ascontiguousarray(setpoint, np.int32),
        np.ascontiguousarray(load_n, np.float64),
        position_lsb_um,
        delay_periods,
        hold_periods,
        int(parameters.motor_speed_rpm * COUNTS_PER_RPM),
        position,
        velocity,
        flags,
        states,
    )
    return ClosedLoopRun(
        reference_m=setpoint * SETPOINT_LSB_M,
        position_m=position,
        command_rpm=velocity / COUNTS_PER_RPM,
        flags=flags,
        states=states,
        saturations=int(io[IO_SATURATIONS]),
    )


def play_closed_loop(
    scenario: Scenario,
    calibration: Calibration,
    *,
    law: int | None = None,
    machine: Machine | None = None,
) -> ClosedLoopRun:
    """Play a scenario as a run over the bus at 1 Mbit/s does: same commands, same positions, bit for bit.

    Parameters
    ----------
    scenario : Scenario
    calibration : Calibration
    law : int, optional
        Control law, instead of the calibration's default.
    machine : Machine, optional
        Instead of the scenario's.

    Returns
    -------
    run : ClosedLoopRun
        Its `reference_m` is the scenario's, not rounded.

    Raises
    ------
    ScenarioError
        If the scenario has faults.
    """
    if scenario.faults:
        raise ScenarioError(f"{scenario.name} has faults, which need the bus")
    machine = machine or scenario.machine
    parameters, reference_m = machine.parameters, scenario.reference_m()
    setpoint = setpoint_counts(reference_m)
    plant = initial_state(parameters, min(max(setpoint[0] * SETPOINT_LSB_M, 0.0), parameters.stroke_m))
    for _ in range(BRING_UP_PERIODS - RUNNING_BEFORE_START_PERIODS):
        advance(plant, parameters.vector(), 0.0, 0.0, PERIOD_S, SUBSTEPS)
    run = run_closed_loop(
        calibration,
        setpoint,
        scenario.load_n(),
        law=law,
        parameters=parameters,
        position_lsb_um=machine.position_lsb_um,
        delay_periods=machine.delay_periods,
        hold_periods=RUNNING_BEFORE_START_PERIODS,
        plant=plant,
    )
    return replace(run, reference_m=reference_m)
