"""Figures that follow from the parameters: inertia at the rod, the oil's resonance, the pumps' gain."""

import math
from dataclasses import dataclass

import numpy as np

from plant_sim import layout as at
from plant_sim.crane import rod_dynamics
from plant_sim.equilibrium import initial_state
from plant_sim.hydraulics import chamber_volumes
from plant_sim.parameters import PlantParameters


@dataclass(frozen=True, slots=True)
class HydraulicMode:
    """The load bouncing on the oil columns, motor at rest."""

    frequency_hz: float
    """Undamped natural frequency."""
    damping_ratio: float
    """First order in leak and friction; above 1, near the ends of the stroke, nothing oscillates."""


@dataclass(frozen=True, slots=True)
class StateSpaceCoefficients:
    """x⃛ = k1 ẋ + k2 ẍ + k3 ω + f, eq. (8) with the signs that follow from the mended eq. (6)."""

    k1_per_s2: float
    k2_per_s: float
    k3_m_per_rad_s2: float


def effective_mass_kg(parameters: PlantParameters, position_m: float) -> float:
    """Inertia of crane and piston at the rod, J/h² + m_p."""
    return float(rod_dynamics(position_m, parameters.vector())[0])


def gravity_force_n(parameters: PlantParameters, position_m: float) -> float:
    """Weight of the crane at the rod, G/h; > 0 pushes the rod in."""
    return float(rod_dynamics(position_m, parameters.vector())[1])


def oil_stiffness_n_per_m(parameters: PlantParameters, position_m: float) -> tuple[float, float]:
    """Stiffness A²β/V of the closed chambers A and B."""
    volume_a, volume_b = chamber_volumes(position_m, parameters.vector())
    stiffness_a = parameters.bulk_modulus_pa * parameters.piston_area_m2**2 / volume_a
    stiffness_b = parameters.bulk_modulus_pa * parameters.annulus_area_m2**2 / volume_b
    return float(stiffness_a), float(stiffness_b)


def hydraulic_mode(parameters: PlantParameters, position_m: float) -> HydraulicMode:
    """Frequency and damping of the load on the oil columns."""
    mass = effective_mass_kg(parameters, position_m)
    stiffnesses = oil_stiffness_n_per_m(parameters, position_m)
    leak = parameters.leak_m3_per_s_pa * parameters.bulk_modulus_pa
    bleed_rates = [leak / volume for volume in chamber_volumes(position_m, parameters.vector())]
    stiffness = sum(stiffnesses)
    omega = math.sqrt(stiffness / mass)
    bled = sum(k * rate for k, rate in zip(stiffnesses, bleed_rates, strict=True)) / stiffness
    damping = (bled + parameters.damping_n_s_per_m / mass) / (2.0 * omega)
    return HydraulicMode(omega / (2.0 * math.pi), float(damping))


def state_space_coefficients(parameters: PlantParameters, position_m: float) -> StateSpaceCoefficients:
    """k1, k2, k3 of eq. (8) with the crane's effective mass at `position_m`."""
    mass = effective_mass_kg(parameters, position_m)
    stiffness_a, stiffness_b = oil_stiffness_n_per_m(parameters, position_m)
    gain_a = stiffness_a * parameters.pump_a_displacement_m3_per_rad / parameters.piston_area_m2
    gain_b = stiffness_b * parameters.pump_b_displacement_m3_per_rad / parameters.annulus_area_m2
    return StateSpaceCoefficients(
        k1_per_s2=-(stiffness_a + stiffness_b) / mass,
        k2_per_s=-parameters.damping_n_s_per_m / mass,
        k3_m_per_rad_s2=parameters.volumetric_efficiency * (gain_a + gain_b) / mass,
    )


def input_gain_m_per_rad_s2(parameters: PlantParameters, position_m: float) -> float:
    """b(x) = k3: jerk of the rod per rad/s of motor speed."""
    return state_space_coefficients(parameters, position_m).k3_m_per_rad_s2


def speed_gain_m_per_rad(parameters: PlantParameters) -> float:
    """Rod speed per motor speed while extending against the load, η D_A / A_A."""
    flow = parameters.volumetric_efficiency * parameters.pump_a_displacement_m3_per_rad
    return flow / parameters.piston_area_m2


def linearised(parameters: PlantParameters, position_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Linearise the plant at rest at `position_m`, valves shut, off the stops, pumps losing (1 - η).

    Returns
    -------
    a : ndarray, shape (4, 4)
        d/dt of (x, v, p_A, p_B) per unit of each.
    b : ndarray, shape (4,)
        Per rad/s of motor speed, with η D as the pumps' net flow.
    """
    p = parameters.vector()
    rest = initial_state(parameters, position_m)
    step = 1e-6
    area_a, area_b = parameters.piston_area_m2, parameters.annulus_area_m2
    mass, _, _ = rod_dynamics(position_m, p)
    push = area_a * rest[at.PRESSURE_A] - area_b * rest[at.PRESSURE_B] - p[at.ATMOSPHERE_FORCE]

    def acceleration(position: float) -> float:
        inertia, weight, _ = rod_dynamics(position, p)
        return float((push - weight) / inertia)

    volume_a, volume_b = chamber_volumes(position_m, p)
    rate_a, rate_b = parameters.bulk_modulus_pa / volume_a, parameters.bulk_modulus_pa / volume_b
    eta, leak = parameters.volumetric_efficiency, parameters.leak_m3_per_s_pa
    spring = (acceleration(position_m + step) - acceleration(position_m - step)) / (2.0 * step)
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [spring, -parameters.damping_n_s_per_m / mass, area_a / mass, -area_b / mass],
            [0.0, -rate_a * area_a, -rate_a * leak, 0.0],
            [0.0, rate_b * area_b, 0.0, -rate_b * leak],
        ]
    )
    b = np.array(
        [
            0.0,
            0.0,
            rate_a * eta * parameters.pump_a_displacement_m3_per_rad,
            -rate_b * eta * parameters.pump_b_displacement_m3_per_rad,
        ]
    )
    return a, b
