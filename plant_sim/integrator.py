"""TR-BDF2 time stepping of the plant, compiled.

The 2 mL dead volumes put chamber poles at 2e6 1/s beside a 23 Hz load mode, so the step must be implicit
and L-stable. TR-BDF2 (Bank et al. 1985; γ = 2 - √2) is second order, and both of its stages share one
diagonal coefficient. Within a substep the crane's geometry and the chamber volumes are those of the
midpoint, the motor speed is exact, and the accumulator pressure is extrapolated from the start: what remains
is piecewise linear in (v, p_A, p_B) and couples the pressures through v only.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable

from dbc.jit import njit
from plant_sim import layout as at
from plant_sim.crane import end_stop, rod_dynamics
from plant_sim.hydraulics import accumulator_pressure, chamber_inflow, chamber_volumes, pump_flows
from plant_sim.motor import decay_over, speed_after

SUBSTEP_S = 1e-4
"""Longest substep for which the published accuracy holds."""

_GAMMA = 2.0 - np.sqrt(2.0)
_DIAGONAL = 0.5 * _GAMMA
_BDF_NEW = 1.0 / (_GAMMA * (2.0 - _GAMMA))
_BDF_OLD = (1.0 - _GAMMA) ** 2 / (_GAMMA * (2.0 - _GAMMA))

_MAX_ITERATIONS = 20
_PRESSURE_TOLERANCE_PA = 1e-3
_FORCE_TOLERANCE_N = 1e-3


@register_jitable
def _solve_stage(past, guess, step, flows, line_pressure, outer_force, per_mass, rate_a, rate_b, p):  # type: ignore[no-untyped-def]
    """Solve y = past + step · f(y) for y = (x, v, p_A, p_B): Newton until each valve is on the piece assumed.

    Parameters
    ----------
    past : tuple of float
        Explicit part (x, v, p_A, p_B).
    guess : tuple of float
        Start of the iteration, same order.
    step : float
        Diagonal coefficient times the substep, s.
    flows : tuple of float
        From `pump_flows`.
    outer_force : float
        Everything on the rod that is constant within the substep, N.
    per_mass : float
        1 / effective mass, 1/kg.
    rate_a, rate_b : float
        β/V of the chambers, Pa/m³.
    """
    past_x, past_v, past_a, past_b = past
    x, v, pressure_a, pressure_b = guess
    flow_a, loss_a, flow_b, loss_b = flows
    area_a = p[at.PISTON_AREA]
    area_b = p[at.ANNULUS_AREA]
    gain_a = step * rate_a
    gain_b = step * rate_b
    gain_v = step * per_mass
    stop, stop_dx, stop_dv = end_stop(x, v, p)
    for _ in range(_MAX_ITERATIONS):
        offset_a, slope_a, low_a, high_a = chamber_inflow(pressure_a, flow_a, loss_a, line_pressure, p)
        offset_b, slope_b, low_b, high_b = chamber_inflow(pressure_b, flow_b, loss_b, line_pressure, p)
        # pressures as straight lines over v, then one equation for v
        share_a = 1.0 / (1.0 - gain_a * slope_a)
        share_b = 1.0 / (1.0 - gain_b * slope_b)
        free_a = share_a * (past_a + gain_a * (offset_a - slope_a * line_pressure))
        free_b = share_b * (past_b + gain_b * (offset_b - slope_b * line_pressure))
        per_v_a = share_a * gain_a * area_a
        per_v_b = share_b * gain_b * area_b
        free_stop = stop + stop_dx * (past_x - x) - stop_dv * v
        free_force = area_a * free_a - area_b * free_b + outer_force + free_stop
        resistance = area_a * per_v_a + area_b * per_v_b + p[at.VISCOUS_DAMPING] - step * stop_dx - stop_dv
        new_v = (past_v + gain_v * free_force) / (1.0 + gain_v * resistance)
        new_x = past_x + step * new_v
        pressure_a = free_a - per_v_a * new_v
        pressure_b = free_b + per_v_b * new_v
        expected_stop = stop + stop_dx * (new_x - x) + stop_dv * (new_v - v)
        x, v = new_x, new_v
        stop, stop_dx, stop_dv = end_stop(x, v, p)
        excess_a = pressure_a - line_pressure
        excess_b = pressure_b - line_pressure
        if (
            low_a - _PRESSURE_TOLERANCE_PA <= excess_a <= high_a + _PRESSURE_TOLERANCE_PA
            and low_b - _PRESSURE_TOLERANCE_PA <= excess_b <= high_b + _PRESSURE_TOLERANCE_PA
            and np.abs(stop - expected_stop) <= _FORCE_TOLERANCE_N
        ):
            break
    return x, v, pressure_a, pressure_b


@register_jitable
def _substep(start, speeds, oil_volume, load_force, h, p):  # type: ignore[no-untyped-def]
    """Advance (x, v, p_A, p_B) and the accumulator's oil volume by `h` seconds.

    `speeds` holds the motor speed at the start, at γh and at h.
    """
    x, v, pressure_a, pressure_b = start
    area_a = p[at.PISTON_AREA]
    area_b = p[at.ANNULUS_AREA]
    middle = x + 0.5 * h * v
    mass, gravity_force, centripetal = rod_dynamics(middle, p)
    per_mass = 1.0 / mass
    volume_a, volume_b = chamber_volumes(middle, p)
    rate_a = p[at.BULK_MODULUS] / volume_a
    rate_b = p[at.BULK_MODULUS] / volume_b

    line_pressure = accumulator_pressure(oil_volume, p)
    flow_a, loss_a, flow_b, loss_b = pump_flows(speeds[0], p)
    offset_a, slope_a, _, _ = chamber_inflow(pressure_a, flow_a, loss_a, line_pressure, p)
    offset_b, slope_b, _, _ = chamber_inflow(pressure_b, flow_b, loss_b, line_pressure, p)
    inflow_a = offset_a + slope_a * (pressure_a - line_pressure)
    inflow_b = offset_b + slope_b * (pressure_b - line_pressure)
    line_slope = -p[at.POLYTROPIC] * line_pressure / (p[at.GAS_VOLUME] - oil_volume) * (inflow_a + inflow_b)

    steady_force = -p[at.ATMOSPHERE_FORCE] - load_force - gravity_force
    cylinder_force = area_a * pressure_a - area_b * pressure_b - p[at.VISCOUS_DAMPING] * v
    stop, _, _ = end_stop(x, v, p)
    acceleration = (cylinder_force + steady_force + stop + centripetal * v * v) * per_mass
    outer_force = steady_force + centripetal * v * (v + h * acceleration)

    step = _DIAGONAL * h
    past = (
        x + step * v,
        v + step * (cylinder_force + outer_force + stop) * per_mass,
        pressure_a + step * rate_a * (inflow_a - area_a * v),
        pressure_b + step * rate_b * (inflow_b + area_b * v),
    )
    flows = pump_flows(speeds[1], p)
    pressure = line_pressure + _GAMMA * h * line_slope
    stage = _solve_stage(past, start, step, flows, pressure, outer_force, per_mass, rate_a, rate_b, p)
    past = (
        _BDF_NEW * stage[0] - _BDF_OLD * x,
        _BDF_NEW * stage[1] - _BDF_OLD * v,
        _BDF_NEW * stage[2] - _BDF_OLD * pressure_a,
        _BDF_NEW * stage[3] - _BDF_OLD * pressure_b,
    )
    flows = pump_flows(speeds[2], p)
    pressure = line_pressure + h * line_slope
    new_x, new_v, new_a, new_b = _solve_stage(
        past, stage, step, flows, pressure, outer_force, per_mass, rate_a, rate_b, p
    )
    new_a = max(new_a, p[at.VAPOUR_PRESSURE])
    new_b = max(new_b, p[at.VAPOUR_PRESSURE])
    # what the chambers took up left the accumulator: no oil is lost to the step's error
    taken_a = (new_a - pressure_a) / rate_a + area_a * (new_x - x)
    taken_b = (new_b - pressure_b) / rate_b - area_b * (new_x - x)
    return (new_x, new_v, new_a, new_b), oil_volume - taken_a - taken_b


@njit(
    "void(float64[::1], float64[::1], float64, float64, float64, int64)",
    depends=("plant_sim.layout", "plant_sim.crane", "plant_sim.hydraulics", "plant_sim.motor"),
)
def advance(
    state: Any,
    parameter_vector: Any,
    speed_command_rad_s: float,
    load_force_n: float,
    dt_s: float,
    substeps: int,
) -> None:
    """Advance the plant in place by one period in which command and load are constant.

    Parameters
    ----------
    state : ndarray, shape (6,)
        x, v, p_A, p_B, ω, V_oil in SI units, see `plant_sim.layout`.
    parameter_vector : ndarray
        From `PlantParameters.vector`.
    speed_command_rad_s : float
        Motor speed command, > 0 extends.
    load_force_n : float
        External force on the rod, > 0 resists extension.
    dt_s : float
        Length of the period.
    substeps : int
        Number of equal TR-BDF2 substeps; 10 per millisecond for the published accuracy.

    Notes
    -----
    The check valves keep the nominal machine above the vapour pressure at any motor speed and loads of
    ±20 kN. Where they do not (soft oil or a light load, reversed at resonance), a chamber's pressure is held
    at the vapour pressure, and the volume that would be missing there comes out of the accumulator, as
    through a check valve without resistance: oil is conserved, but the cavity refills faster than a real one,
    and there is no pressure spike from its collapse.
    """
    y = (state[at.POSITION], state[at.VELOCITY], state[at.PRESSURE_A], state[at.PRESSURE_B])
    oil_volume = state[at.OIL_VOLUME]
    speed = state[at.MOTOR_SPEED]
    h = dt_s / substeps
    stage_decay = decay_over(_GAMMA * h, parameter_vector)
    decay = decay_over(h, parameter_vector)
    for _ in range(substeps):
        stage_speed = speed_after(speed, speed_command_rad_s, _GAMMA * h, stage_decay, parameter_vector)
        new_speed = speed_after(speed, speed_command_rad_s, h, decay, parameter_vector)
        y, oil_volume = _substep(
            y, (speed, stage_speed, new_speed), oil_volume, load_force_n, h, parameter_vector
        )
        speed = new_speed
    state[at.POSITION], state[at.VELOCITY], state[at.PRESSURE_A], state[at.PRESSURE_B] = y
    state[at.OIL_VOLUME] = oil_volume
    state[at.MOTOR_SPEED] = speed
