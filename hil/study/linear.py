"""The sampled loop, linearised: plant, delay and control law at one position, their eigenvalues and Ms.

What is outside the feedback (differentiator, setpoint limiter, feed-forward) is left out; so are quantisation
and the limits of drive, motor and command slew. fal counts with slope 1, its linear zone: beyond it its gain
falls, so that a verdict holds for small signals only. A loop that is stable here may cycle at a large
amplitude, one that is unstable here may settle on a small cycle.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from firmware_py.kernel import layout as k
from firmware_py.tuning import (
    PERIOD_S,
    AdrcTuning,
    CommandFilterTuning,
    FrontEndTuning,
    PiTuning,
    ScheduledTuning,
    Tuning,
)
from plant_sim.derived import linearised, linearised_about, steady_motion
from plant_sim.drive import MAX_DELAY_PERIODS
from plant_sim.machine import Machine
from plant_sim.parameters import PlantParameters

FREQUENCIES_RAD_S = np.geomspace(0.1, np.pi / PERIOD_S, 200)
"""Where the sensitivity is looked at, up to Nyquist; each loop's own eigenfrequencies are added."""
_DEFECTIVE = 1e10
"""Condition of the eigenvectors from which on they span nothing that can be computed with."""
REFINEMENT = 33
"""Points between the neighbours of the highest one, in a second look."""


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace:
    """s(k+1) = a s(k) + b in(k), out(k) = c s(k) + d in(k), one input and one output, period 1 ms.

    Shapes are a (..., n, n), b (..., n), c (..., n), d (...); leading dimensions are loops side by side.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray

    @classmethod
    def stacked(cls, models: Sequence["StateSpace"]) -> "StateSpace":
        """Return models of equal order as one with a leading dimension."""
        return cls(*(np.stack([getattr(model, name) for model in models]) for name in ("a", "b", "c", "d")))


Linearisation = Callable[[PlantParameters, float], tuple[np.ndarray, np.ndarray]]
LOWERING_M_S = -0.1


def _moving(velocity_m_s: float) -> Linearisation:
    def linearise(parameters: PlantParameters, position_m: float) -> tuple[np.ndarray, np.ndarray]:
        motion = steady_motion(parameters, position_m, velocity_m_s)
        return linearised_about(parameters, motion)

    return linearise


OPERATING_POINTS: dict[str, Linearisation] = {
    "shut": linearised,
    "held": _moving(0.0),
    "lowering": _moving(LOWERING_M_S),
}
"""About what the plant is linearised.

shut: both chambers closed and flows of η D, the paper's model. held: where a controller really holds the rod,
the check valve of the rod side conducting, so that this side's oil is no spring. lowering: the same at
-0.1 m/s, where the load drives oil through pump A and its gain is (2 - η) D instead of η D; no machine gets
to do that in the last millimetres before the stop.
"""


def plant_model(machine: Machine, position_m: float, point: str = "held") -> StateSpace:
    """Return drive, motor and plant, from the speed commanded at t_k (rad/s) to the position at t_k (m).

    The command is held from t_k+delay to t_k+delay+1. States: x, v, p_A, p_B, ω, then the last
    `MAX_DELAY_PERIODS` commands, newest first.

    Parameters
    ----------
    machine : Machine
    position_m : float
        Rod position, off the stops.
    point : str
        One of `OPERATING_POINTS`.

    Raises
    ------
    ValueError
        If there is no such point, or the position is outside the stroke.
    """
    if point not in OPERATING_POINTS:
        raise ValueError(f"point is {point!r}, must be one of {', '.join(OPERATING_POINTS)}")
    return driven_plant(*OPERATING_POINTS[point](machine.parameters, position_m), machine)


def _sampled(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b of a system whose input is held over a period."""
    rates, modes = np.linalg.eig(a)
    if np.linalg.cond(modes) > _DEFECTIVE:
        held = np.zeros((len(b) + 1, len(b) + 1))
        held[:-1, :-1], held[:-1, -1] = a, b
        grown = expm(held * PERIOD_S)
        return grown[:-1, :-1], grown[:-1, -1]
    # else by eigenvectors: scipy's expm waits for BLAS threads, ten times as long on a busy machine
    inverse = np.linalg.inv(modes)
    gathered = np.where(
        rates == 0.0, PERIOD_S, np.expm1(rates * PERIOD_S) / np.where(rates == 0.0, 1.0, rates)
    )
    return ((modes * np.exp(rates * PERIOD_S)) @ inverse).real, ((modes * gathered) @ inverse @ b).real


def driven_plant(a: np.ndarray, b: np.ndarray, machine: Machine) -> StateSpace:
    """Return what `plant_model` does, from a linearisation; of the machine, only its drive counts."""
    bandwidth = 1.0 / machine.motor_time_constant_s
    continuous = np.zeros((5, 5))
    continuous[:4, :4] = a
    continuous[:4, 4] = b
    continuous[4, 4] = -bandwidth
    sampled, driven = _sampled(continuous, np.array([0.0, 0.0, 0.0, 0.0, bandwidth]))
    order = 5 + MAX_DELAY_PERIODS
    model = StateSpace(np.zeros((order, order)), np.zeros(order), np.zeros(order), np.zeros(()))
    model.a[:5, :5] = sampled
    model.a[:5, 4 + machine.delay_periods] = driven
    model.a[6:, 5:-1] = np.eye(MAX_DELAY_PERIODS - 1)
    model.b[5] = 1.0
    model.c[0] = 1.0
    return model


def pi_model(gains: PiTuning) -> StateSpace:
    """Return P or PI from position (m) to command (rad/s), the setpoint at rest. State: the integral part."""
    ki = gains.ki_rad_s2_per_m * PERIOD_S
    order = 1 if ki else 0
    return StateSpace(
        a=np.eye(order),
        b=np.full(order, -ki),
        c=np.ones(order),
        d=np.array(-(gains.kp_rad_s_per_m + ki)),
    )


def adrc_model(gains: AdrcTuning) -> StateSpace:
    """Return observer and feedback from position (m) to command (rad/s) in their linear zones.

    States: z1..z4 and the command sent last, which the observer is fed.
    """
    w_o, w_c, b0 = gains.omega_o_rad_s, gains.omega_c_rad_s, gains.b0_m_s2_per_rad
    injection = PERIOD_S * np.array([4 * w_o, 6 * w_o**2, 4 * w_o**3, w_o**4])
    model = np.array(
        [
            [0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0, 0.0],
            [0.0, gains.a1n_per_s2, gains.a2n_per_s, 1.0, b0],
            [0.0, 0.0, 0.0, 0.0, 0.0],
        ]
    )
    observe = np.eye(4, 5) + PERIOD_S * model
    observe[:, 0] -= injection
    feedback = -np.array([w_c**3, 3 * w_c**2 + gains.a1n_per_s2, 3 * w_c + gains.a2n_per_s, 1.0]) / b0
    return observer_with_feedback(observe, injection, feedback)


def scheduled_model(
    gains: ScheduledTuning, front_end: FrontEndTuning, command_filter: CommandFilterTuning, position_m: float
) -> StateSpace:
    """Return the scheduled observer, feedback and command filter from position (m) to command (rad/s).

    b0, a1n and the gains that follow them are those at `position_m`; the observer's motor speed per rod speed
    is the mean of both directions, between which it has a kink at rest. States: z1, z2, z3, the disturbance
    as a speed, the motor's model, and the command sent last.
    """
    stiff = gains.stiffness(position_m)
    b0 = gains.b0_m_s2_per_rad * stiff
    kappa = (front_end.extend_rad_per_m + front_end.retract_rad_per_m) / 2
    betas = gains.beta1_per_s, gains.beta2_per_s2, gains.beta3_per_s3
    beta4 = gains.omega_d_rad_s * (gains.beta3_per_s3 / b0 + kappa * gains.beta1_per_s)
    motor = _lag_share(gains.motor_time_constant_s)
    injection = PERIOD_S * np.array([*betas, beta4, 0.0])
    observe = np.eye(5, 6)
    observe[:2, 1:3] += PERIOD_S * np.eye(2)
    observe[4, 4:] = 1.0 - motor, motor
    observe[2] += PERIOD_S * b0 * (observe[4] + np.array([0.0, -kappa, 0.0, 1.0, 0.0, 0.0]))
    observe[:, 0] -= injection
    damping = gains.k3_rad_s2_per_m + gains.k3_soft_rad_s2_per_m / stiff
    feedback = -np.array([gains.k1_rad_s_per_m, gains.k2_rad_per_m, damping, 1.0, 0.0])
    return observer_with_feedback(observe, injection, feedback, _lag_share(command_filter.time_constant_s))


def observer_with_feedback(
    observe: np.ndarray, injection: np.ndarray, feedback: np.ndarray, share: float = 1.0
) -> StateSpace:
    """Return the controller whose command follows `feedback` · z(k+1), and whose observer is fed the command.

    Parameters
    ----------
    observe : ndarray, shape (n, n + 1)
        z(k+1) from z(k) and the command sent last.
    injection : ndarray, shape (n,)
        z(k+1) from the position measured at k.
    feedback : ndarray, shape (n,)
        Wanted command from z(k+1).
    share : float
        Share of the way from the last command to the wanted one, 1 without a low-pass.
    """
    command = share * (feedback @ observe)
    command[-1] += 1.0 - share
    direct = share * (feedback @ injection)
    return StateSpace(np.vstack([observe, command]), np.append(injection, direct), command, np.array(direct))


def low_passed(model: StateSpace, command_filter: CommandFilterTuning) -> StateSpace:
    """Return a controller with the command filter behind it; the last state is the command sent last."""
    share = _lag_share(command_filter.time_constant_s)
    command = np.append(share * model.c, 1.0 - share)
    return StateSpace(
        np.vstack([np.pad(model.a, ((0, 0), (0, 1))), command]),
        np.append(model.b, share * model.d),
        command,
        share * model.d,
    )


def _lag_share(time_constant_s: float) -> float:
    """Return the share of a step that a first-order lag passes in a period."""
    return -math.expm1(-PERIOD_S / time_constant_s) if time_constant_s else 1.0


CONTROLLER_MODELS: dict[int, Callable[[Tuning, float], StateSpace]] = {
    k.LAW_P: lambda tuning, position_m: pi_model(tuning.p),
    k.LAW_PI: lambda tuning, position_m: pi_model(tuning.pi),
    k.LAW_ADRC: lambda tuning, position_m: adrc_model(tuning.adrc),
    k.LAW_PI_FF: lambda tuning, position_m: low_passed(pi_model(tuning.pi), tuning.command_filter),
    k.LAW_SCHEDULED: lambda tuning, position_m: scheduled_model(
        tuning.scheduled, tuning.front_end, tuning.command_filter, position_m
    ),
}
"""From position (m) to command (rad/s), by law, for a tuning at a position (m)."""


def controller_model(tuning: Tuning, position_m: float, law: int | None = None) -> StateSpace:
    """Return the controller of a tuning, or of another law with its gains, at `position_m`."""
    return CONTROLLER_MODELS[tuning.law if law is None else law](tuning, position_m)


def closed_loop(plant: StateSpace, controller: StateSpace) -> np.ndarray:
    """Return the matrix of both in one, shape (..., n + m, n + m); leading shapes broadcast."""
    n = plant.a.shape[-1]
    shape = np.broadcast_shapes(plant.a.shape[:-2], controller.a.shape[:-2])
    order = n + controller.a.shape[-1]
    matrix = np.empty((*shape, order, order))
    input_column = plant.b[..., :, None]
    matrix[..., :n, :n] = plant.a + input_column * controller.d[..., None, None] * plant.c[..., None, :]
    matrix[..., :n, n:] = input_column * controller.c[..., None, :]
    matrix[..., n:, :n] = controller.b[..., :, None] * plant.c[..., None, :]
    matrix[..., n:, n:] = controller.a
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class LinearLoop:
    """What the linear loop is like, for one loop or an array of loops.

    Attributes
    ----------
    eigenvalues : ndarray, shape (..., n)
        Of the closed loop per period; all inside the unit circle is stable.
    spectral_radius : ndarray, shape (...)
        Largest magnitude of them.
    ms : ndarray, shape (...)
        Peak of the sensitivity |1 / (1 + L)| up to Nyquist; infinite where the loop is unstable.
    """

    eigenvalues: np.ndarray
    spectral_radius: np.ndarray
    ms: np.ndarray

    @property
    def stable(self) -> np.ndarray:
        """Whether all eigenvalues are inside the unit circle."""
        return self.spectral_radius < 1.0


def linear_loop(plant: StateSpace, controller: StateSpace) -> LinearLoop:
    """Return eigenvalues and sensitivity peak of a loop, or of many side by side.

    The sensitivity is the quotient of the open and the closed loop's characteristic polynomials.
    """
    closed = np.linalg.eigvals(closed_loop(plant, controller))
    poles = (np.linalg.eigvals(plant.a), np.linalg.eigvals(controller.a))

    def sensitivity(angle: np.ndarray) -> np.ndarray:
        z = np.exp(1j * angle)
        quotient = np.ones_like(z)
        for part in poles:
            for index in range(part.shape[-1]):
                quotient *= z - part[..., index, None]
        for index in range(closed.shape[-1]):
            quotient /= z - closed[..., index, None]
        return np.abs(quotient)

    shape = closed.shape[:-1]
    common = np.broadcast_to(FREQUENCIES_RAD_S * PERIOD_S, (*shape, FREQUENCIES_RAD_S.size))
    angle = np.sort(np.concatenate([common, np.abs(np.angle(closed))], axis=-1))
    highest = sensitivity(angle).argmax(axis=-1)[..., None]
    left = np.take_along_axis(angle, np.maximum(highest - 1, 0), axis=-1)
    right = np.take_along_axis(angle, np.minimum(highest + 1, angle.shape[-1] - 1), axis=-1)
    peak = sensitivity(left + (right - left) * np.linspace(0.0, 1.0, REFINEMENT)).max(axis=-1)
    radius = np.abs(closed).max(axis=-1)
    return LinearLoop(closed, radius, np.where(radius < 1.0, peak, np.inf))


def analyse(
    tuning: Tuning,
    position_m: float,
    *,
    machine: Machine = Machine(),  # noqa: B008 - frozen
    law: int | None = None,
    point: str = "held",
) -> LinearLoop:
    """Return the linear loop of a tuning with a machine at one position.

    Parameters
    ----------
    tuning : Tuning
    position_m : float
        Rod position, off the stops.
    machine : Machine
        Acceleration limit and sensor resolution do not enter.
    law : int, optional
        Control law, instead of the tuning's own.
    point : str
        One of `OPERATING_POINTS`.
    """
    return linear_loop(plant_model(machine, position_m, point), controller_model(tuning, position_m, law))
