"""Run the plant open loop from arrays."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plant_sim import layout as at
from plant_sim.equilibrium import initial_state
from plant_sim.hydraulics import accumulator_pressure
from plant_sim.integrator import SUBSTEP_S, advance
from plant_sim.parameters import NOMINAL, PlantParameters


@dataclass(frozen=True, slots=True, eq=False)
class PlantTrace:
    """A run sampled at the start of each period; every array has one entry per period, SI units."""

    time_s: np.ndarray
    speed_command_rad_s: np.ndarray
    load_force_n: np.ndarray
    position_m: np.ndarray
    velocity_m_s: np.ndarray
    pressure_a_pa: np.ndarray
    pressure_b_pa: np.ndarray
    pressure_accumulator_pa: np.ndarray
    motor_speed_rad_s: np.ndarray
    oil_volume_m3: np.ndarray


def simulate(
    speed_command_rad_s: ArrayLike,
    load_force_n: ArrayLike = 0.0,
    dt_s: float = 1e-3,
    parameters: PlantParameters = NOMINAL,
    *,
    initial_position_m: float = 0.0,
) -> PlantTrace:
    """Simulate the plant from rest under a given motor speed command.

    Parameters
    ----------
    speed_command_rad_s : array_like, shape (n,)
        Command held over each period, > 0 extends.
    load_force_n : float or array_like, shape (n,)
        External force on the rod held over each period, > 0 resists extension.
    dt_s : float
        Period; it is divided into substeps of at most 100 µs.
    parameters : PlantParameters
    initial_position_m : float
        Where the rod rests at the start, see `initial_state`.

    Returns
    -------
    PlantTrace
        Entry k is the state at the start of period k, before its command has acted.

    Raises
    ------
    ValueError
        If an array holds NaN or infinity, has the wrong shape or length, or dt_s is not positive.

    Examples
    --------
    >>> trace = simulate(np.full(1000, 100.0))
    >>> print(f"{trace.position_m[-1]:.3f} m")
    0.060 m
    """
    speed = _finite_array("speed_command_rad_s", speed_command_rad_s)
    if speed.ndim != 1:
        raise ValueError(f"speed_command_rad_s has {speed.ndim} dimensions, must have 1")
    load = _finite_array("load_force_n", load_force_n)
    if load.shape not in ((), speed.shape):
        raise ValueError(f"load_force_n has shape {load.shape}, must be a number or have shape {speed.shape}")
    if not (math.isfinite(dt_s) and dt_s > 0.0):
        raise ValueError(f"dt_s is {dt_s!r}, must be positive and finite")
    load = np.broadcast_to(load, speed.shape).copy()

    state = initial_state(parameters, initial_position_m)
    p = parameters.vector()
    substeps = math.ceil(dt_s / SUBSTEP_S * (1.0 - 1e-12))
    states = np.empty((len(speed), at.STATE_SIZE))
    for k in range(len(speed)):
        states[k] = state
        advance(state, p, speed[k], load[k], dt_s, substeps)
    return PlantTrace(
        time_s=np.arange(len(speed)) * dt_s,
        speed_command_rad_s=speed,
        load_force_n=load,
        position_m=states[:, at.POSITION],
        velocity_m_s=states[:, at.VELOCITY],
        pressure_a_pa=states[:, at.PRESSURE_A],
        pressure_b_pa=states[:, at.PRESSURE_B],
        pressure_accumulator_pa=accumulator_pressure(states[:, at.OIL_VOLUME], p),
        motor_speed_rad_s=states[:, at.MOTOR_SPEED],
        oil_volume_m3=states[:, at.OIL_VOLUME],
    )


def _finite_array(name: str, values: ArrayLike) -> np.ndarray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is not an array of numbers") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or infinity")
    return array
