"""Figures that follow from the parameters: inertia at the rod, the oil's resonance, the pumps' gain."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from plant_sim import layout as at
from plant_sim.crane import rod_dynamics
from plant_sim.equilibrium import initial_state
from plant_sim.hydraulics import accumulator_pressure, chamber_inflow, chamber_volumes, pump_flows
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
    return coefficients_of_stiffness(parameters, mass, *oil_stiffness_n_per_m(parameters, position_m))


def coefficients_of_stiffness(
    parameters: PlantParameters, mass_kg: float, stiffness_a_n_per_m: float, stiffness_b_n_per_m: float
) -> StateSpaceCoefficients:
    """k1, k2, k3 of eq. (8) with given stiffnesses A²β/V of the chambers."""
    gain_a = stiffness_a_n_per_m * parameters.pump_a_displacement_m3_per_rad / parameters.piston_area_m2
    gain_b = stiffness_b_n_per_m * parameters.pump_b_displacement_m3_per_rad / parameters.annulus_area_m2
    return StateSpaceCoefficients(
        k1_per_s2=-(stiffness_a_n_per_m + stiffness_b_n_per_m) / mass_kg,
        k2_per_s=-parameters.damping_n_s_per_m / mass_kg,
        k3_m_per_rad_s2=parameters.volumetric_efficiency * (gain_a + gain_b) / mass_kg,
    )


def input_gain_m_per_rad_s2(parameters: PlantParameters, position_m: float) -> float:
    """b(x) = k3: jerk of the rod per rad/s of motor speed."""
    return state_space_coefficients(parameters, position_m).k3_m_per_rad_s2


def speed_gain_m_per_rad(parameters: PlantParameters) -> float:
    """Rod speed per motor speed while extending against the load, η D_A / A_A."""
    flow = parameters.volumetric_efficiency * parameters.pump_a_displacement_m3_per_rad
    return flow / parameters.piston_area_m2


@dataclass(frozen=True, slots=True, eq=False)
class SteadyMotion:
    """The motor moves the rod at one velocity, or holds it against the leak; pressures stand still."""

    state: np.ndarray
    """As the integrator takes it, see `plant_sim.layout`."""
    inflow_slopes: tuple[float, float]
    """What a pascal more lets into the chambers A and B, m³/(s Pa), on the piece their valves are on."""
    inflow_gains: tuple[float, float]
    """What a rad/s more brings into the chambers A and B, m³/rad, at this direction of the motor."""


def steady_motion(
    parameters: PlantParameters, position_m: float, velocity_m_s: float = 0.0, load_n: float = 0.0
) -> SteadyMotion:
    """Solve for the motor speed and the pressures that move the rod through `position_m` at `velocity_m_s`.

    At 0 this is the rest that a position controller keeps up. There, as in most steady motion, pump B draws
    more than the rod displaces: the rod side's pressure falls until its check valve conducts.

    Raises
    ------
    ValueError
        If the position is outside the stroke, nothing leaks, or the motor cannot give that velocity.
    """
    if parameters.leak_m3_per_s_pa == 0.0:
        raise ValueError(
            "leak_m3_per_s_pa is 0: without a leak the pressures of a steady motion are not unique"
        )
    p = parameters.vector()
    state = initial_state(parameters, position_m)
    line = float(accumulator_pressure(state[at.OIL_VOLUME], p))
    far = 1e9
    corners = (-p[at.PUMP_LOSS_PRESSURE], -p[at.CHECK_CRACK], p[at.PUMP_LOSS_PRESSURE], p[at.RELIEF_CRACK])
    excess = np.array([-far, *sorted(corners), far])

    def inflow(pressure: float, pump_loss: float) -> float:
        offset, slope, _, _ = chamber_inflow(pressure, 0.0, pump_loss, line, p)
        return float(offset + slope * (pressure - line))

    # inflow at the corners of its polygon over pressure: valves and leak, and what a unit of pump loss adds
    valves = np.array([inflow(line + e, 0.0) for e in excess])
    per_loss = np.array([inflow(line + e, 1.0) for e in excess]) - valves

    def pressures(speed: float) -> tuple[float, float]:
        flow_a, loss_a, flow_b, loss_b = pump_flows(speed, p)
        inflow_a = valves + flow_a + loss_a * per_loss
        inflow_b = valves + flow_b + loss_b * per_loss
        return (
            line + float(np.interp(p[at.PISTON_AREA] * velocity_m_s, inflow_a[::-1], excess[::-1])),
            line + float(np.interp(-p[at.ANNULUS_AREA] * velocity_m_s, inflow_b[::-1], excess[::-1])),
        )

    _, weight, centripetal = rod_dynamics(position_m, p)
    resistance = weight + p[at.ATMOSPHERE_FORCE] + load_n
    resistance += p[at.VISCOUS_DAMPING] * velocity_m_s - centripetal * velocity_m_s**2

    def surplus(speed: float) -> float:
        pressure_a, pressure_b = pressures(speed)
        return float(p[at.PISTON_AREA] * pressure_a - p[at.ANNULUS_AREA] * pressure_b - resistance)

    top = parameters.motor_speed_rad_s
    if not surplus(-top) <= 0.0 <= surplus(top):
        raise ValueError(f"velocity_m_s is {velocity_m_s!r}, beyond what the motor gives at {position_m:g} m")
    speed = float(brentq(surplus, -top, top, xtol=1e-12))
    pressure_a, pressure_b = pressures(speed)
    state[at.VELOCITY] = velocity_m_s
    state[at.PRESSURE_A], state[at.PRESSURE_B] = pressure_a, pressure_b
    state[at.MOTOR_SPEED] = speed
    flow_a, loss_a, flow_b, loss_b = pump_flows(math.copysign(1.0, speed), p)
    slopes = tuple(
        float(chamber_inflow(pressure, 0.0, abs(speed) * loss, line, p)[1])
        for pressure, loss in ((pressure_a, loss_a), (pressure_b, loss_b))
    )
    gains = tuple(
        math.copysign(1.0, speed) * float(flow + loss * np.interp(pressure - line, excess, per_loss))
        for pressure, flow, loss in ((pressure_a, flow_a, loss_a), (pressure_b, flow_b, loss_b))
    )
    return SteadyMotion(state, slopes, gains)  # type: ignore[arg-type]


def linearised(parameters: PlantParameters, position_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Linearise the plant at rest at `position_m`, valves shut, off the stops, pumps losing (1 - η).

    This is the paper's model with a leak: both chambers closed, flows of eqs (1), (2). No lasting rest is so,
    see `steady_motion`.

    Returns
    -------
    a : ndarray, shape (4, 4)
        d/dt of (x, v, p_A, p_B) per unit of each.
    b : ndarray, shape (4,)
        Per rad/s of motor speed, with η D as the pumps' net flow.
    """
    leak, eta = parameters.leak_m3_per_s_pa, parameters.volumetric_efficiency
    flows = (
        eta * parameters.pump_a_displacement_m3_per_rad,
        -eta * parameters.pump_b_displacement_m3_per_rad,
    )
    return _linear_plant(
        parameters, position_m, 0.0, gravity_force_n(parameters, position_m), (-leak, -leak), flows
    )


def linearised_about(parameters: PlantParameters, motion: SteadyMotion) -> tuple[np.ndarray, np.ndarray]:
    """Linearise the plant about a steady motion, geometry and volumes frozen where it passes.

    The accumulator's pressure is taken as constant: it is four orders of magnitude softer than the chambers.

    Returns
    -------
    a : ndarray, shape (4, 4)
        d/dt of (x, v, p_A, p_B) per unit of each.
    b : ndarray, shape (4,)
        Per rad/s of motor speed.
    """
    p = parameters.vector()
    x, v = motion.state[at.POSITION], motion.state[at.VELOCITY]
    _, weight, centripetal = rod_dynamics(x, p)
    push = weight - centripetal * v**2
    return _linear_plant(parameters, float(x), float(v), push, motion.inflow_slopes, motion.inflow_gains)


def _linear_plant(
    parameters: PlantParameters,
    position_m: float,
    velocity_m_s: float,
    push_n: float,
    inflow_slopes: tuple[float, float],
    inflow_gains: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """a, b of (x, v, p_A, p_B); `push_n` is what oil, friction and load give together in the steady state."""
    p = parameters.vector()
    step = 1e-6
    mass, _, centripetal = rod_dynamics(position_m, p)

    def acceleration(position: float) -> float:
        inertia, weight, turning = rod_dynamics(position, p)
        return float((push_n - weight + turning * velocity_m_s**2) / inertia)

    area_a, area_b = parameters.piston_area_m2, parameters.annulus_area_m2
    rate_a, rate_b = (parameters.bulk_modulus_pa / volume for volume in chamber_volumes(position_m, p))
    spring = (acceleration(position_m + step) - acceleration(position_m - step)) / (2.0 * step)
    drag = (2.0 * centripetal * velocity_m_s - parameters.damping_n_s_per_m) / mass
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [spring, drag, area_a / mass, -area_b / mass],
            [0.0, -rate_a * area_a, rate_a * inflow_slopes[0], 0.0],
            [0.0, rate_b * area_b, 0.0, rate_b * inflow_slopes[1]],
        ]
    )
    b = np.array([0.0, 0.0, rate_a * inflow_gains[0], rate_b * inflow_gains[1]])
    return a, b
