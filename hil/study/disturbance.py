"""The total disturbance that an observer should see, from the plant's own equations."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.tuning import AdrcTuning
from hil.scenario import PERIOD_S
from plant_sim import layout as at
from plant_sim.crane import end_stop, rod_dynamics
from plant_sim.hydraulics import chamber_inflow, chamber_volumes, pump_flows
from plant_sim.parameters import NOMINAL, PlantParameters

_STEP_S = 1e-7
_LONGEST_DELAY_PERIODS = 100


@dataclass(frozen=True, slots=True)
class ObserverError:
    """How far an observed disturbance is from the true one.

    Attributes
    ----------
    true_rms_m_s3 : float
        RMS of the true one.
    rms_m_s3 : float
        RMS of the difference at the same instants.
    relative : float
        The same as a share of `true_rms_m_s3`.
    delay_ms : int
        By how much the true one has to be delayed for the smallest difference.
    delayed_relative : float
        The share that is left then.
    """

    true_rms_m_s3: float
    rms_m_s3: float
    relative: float
    delay_ms: int
    delayed_relative: float


def true_disturbance_m_s3(
    record: Mapping[str, np.ndarray], adrc: AdrcTuning, parameters: PlantParameters = NOMINAL
) -> np.ndarray:
    """Return what the plant did beyond the controller's nominal model, at each sampling instant.

    The model is x⃛ = a1n ẋ + a2n ẍ + b0 u + f (eq. 25), so f = x⃛ - a1n ẋ - a2n ẍ - b0 u, with u the speed
    command that the drive holds from that instant on: the one that the observer has for the same period. ẍ is
    the force balance (7), (9), (10), and x⃛ its derivative along the plant's own ẋ, ẍ, ṗ_A and ṗ_B: nothing
    is differentiated over time. A step of the load makes ẍ jump, which x⃛ between the steps does not show.

    Parameters
    ----------
    record : mapping of ndarray, shape (periods,)
        The plant node's record.
    adrc : AdrcTuning
        Whose nominal model.
    parameters : PlantParameters
        Of the plant.

    Returns
    -------
    disturbance_m_s3 : ndarray, shape (periods,)
    """
    p = parameters.vector()
    columns = (
        "position_m",
        "velocity_m_s",
        "pressure_a_pa",
        "pressure_b_pa",
        "pressure_accumulator_pa",
        "motor_speed_rad_s",
        "load_n",
    )
    rows = np.column_stack([record[name] for name in columns]).tolist()
    acceleration, jerk = np.array([_acceleration_and_jerk(row, p) for row in rows]).T
    nominal = adrc.a1n_per_s2 * record["velocity_m_s"] + adrc.a2n_per_s * acceleration
    return jerk - nominal - adrc.b0_m_s2_per_rad * record["speed_command_rad_s"]


def observer_error(observed_m_s3: np.ndarray, true_m_s3: np.ndarray) -> ObserverError:
    """Compare an observer's estimate with the truth at the same instants, one row per control period."""
    true_rms = _rms(true_m_s3)
    delayed = [
        _rms(observed_m_s3[delay:] - true_m_s3[: len(true_m_s3) - delay])
        for delay in range(_LONGEST_DELAY_PERIODS)
    ]
    delay = int(np.argmin(delayed))
    return ObserverError(
        true_rms_m_s3=true_rms,
        rms_m_s3=delayed[0],
        relative=delayed[0] / true_rms,
        delay_ms=round(delay * PERIOD_S * 1e3),
        delayed_relative=delayed[delay] / true_rms,
    )


def _acceleration_and_jerk(row: Sequence[float], p: np.ndarray) -> tuple[float, float]:
    x, v, p_a, p_b, line, speed, load = row
    volume_a, volume_b = chamber_volumes(x, p)
    flow_a, loss_a, flow_b, loss_b = pump_flows(speed, p)
    offset_a, slope_a, _, _ = chamber_inflow(p_a, flow_a, loss_a, line, p)
    offset_b, slope_b, _, _ = chamber_inflow(p_b, flow_b, loss_b, line, p)
    rate_a = p[at.BULK_MODULUS] / volume_a * (offset_a + slope_a * (p_a - line) - p[at.PISTON_AREA] * v)
    rate_b = p[at.BULK_MODULUS] / volume_b * (offset_b + slope_b * (p_b - line) + p[at.ANNULUS_AREA] * v)
    acceleration = _acceleration(x, v, p_a, p_b, load, p)
    before, after = (
        _acceleration(x + h * v, v + h * acceleration, p_a + h * rate_a, p_b + h * rate_b, load, p)
        for h in (-_STEP_S, _STEP_S)
    )
    return acceleration, (after - before) / (2.0 * _STEP_S)


def _acceleration(x: float, v: float, p_a: float, p_b: float, load: float, p: np.ndarray) -> float:
    mass, gravity, centripetal = rod_dynamics(x, p)
    stop, _, _ = end_stop(x, v, p)
    push = p[at.PISTON_AREA] * p_a - p[at.ANNULUS_AREA] * p_b - p[at.ATMOSPHERE_FORCE]
    force = push - load - gravity - p[at.VISCOUS_DAMPING] * v + stop + centripetal * v * v
    return float(force / mass)


def _rms(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))
