"""Where the machine rests."""

import numpy as np

from plant_sim import layout as at
from plant_sim.crane import rod_dynamics
from plant_sim.hydraulics import accumulator_pressure, chamber_volumes
from plant_sim.parameters import PlantParameters

_PASSES = 50


def initial_state(parameters: PlantParameters, position_m: float = 0.0) -> np.ndarray:
    """Return the state at rest (v = 0, ω = 0, forces in balance) at `position_m`.

    At 0 the rod leans on the retracted stop with both chambers at the accumulator's precharge: about 3 µm
    inside the stop, and nothing moves. Elsewhere the chamber that carries the load holds the pressure the
    force balance asks for and the other one is at the accumulator's pressure, so all valves are shut. The
    loaded chamber then leaks, and with the motor at rest the rod creeps from there at a few mm/s: with a leak
    and a still motor no position off the stop is a lasting equilibrium.
    The accumulator holds what is left of the oil of a machine filled to the precharge with the rod retracted.

    Parameters
    ----------
    parameters : PlantParameters
    position_m : float
        Rod position in [0, stroke].

    Returns
    -------
    state : ndarray, shape (6,)
        Indexed by `plant_sim.layout`.

    Raises
    ------
    ValueError
        If `position_m` is not a number in the stroke.
    """
    if not 0.0 <= position_m <= parameters.stroke_m:
        raise ValueError(f"position_m is {position_m!r}, must be in [0, {parameters.stroke_m:g}]")
    p = parameters.vector()
    state = np.zeros(at.STATE_SIZE)
    precharge = parameters.accumulator_precharge_pa

    if position_m == 0.0 and _inward_force(0.0, precharge, p) >= 0.0:
        x = 0.0
        for _ in range(_PASSES):
            x = -_inward_force(x, precharge, p) / p[at.STOP_STIFFNESS]
        state[at.POSITION] = x
        state[at.PRESSURE_A] = state[at.PRESSURE_B] = precharge
        return state

    volume_a, volume_b = chamber_volumes(position_m, p)
    oil_volume = 0.0
    for _ in range(_PASSES):
        line_pressure = accumulator_pressure(oil_volume, p)
        inward = _inward_force(position_m, line_pressure, p)
        pressure_a = line_pressure + max(inward, 0.0) / p[at.PISTON_AREA]
        pressure_b = line_pressure + max(-inward, 0.0) / p[at.ANNULUS_AREA]
        compressed = volume_a * (pressure_a - precharge) + volume_b * (pressure_b - precharge)
        oil_volume = -parameters.rod_area_m2 * position_m - compressed / p[at.BULK_MODULUS]
    state[at.POSITION] = position_m
    state[at.PRESSURE_A] = pressure_a
    state[at.PRESSURE_B] = pressure_b
    state[at.OIL_VOLUME] = oil_volume
    return state


def _inward_force(position: float, pressure: float, p: np.ndarray) -> float:
    """Force in N that pushes the rod in while both chambers are at `pressure`."""
    _, gravity_force, _ = rod_dynamics(position, p)
    rod_area = p[at.PISTON_AREA] - p[at.ANNULUS_AREA]
    return float(gravity_force + p[at.ATMOSPHERE_FORCE] - rod_area * pressure)
