"""A second, independent implementation of the plant: its equations integrated by scipy's Radau.

Nothing of plant_sim is used. The motor is integrated like any other state instead of solved exactly, volumes
and geometry follow the state at every instant, and the sine and cosine of every angle are taken as such.
"""

from dataclasses import dataclass
from math import acos, cos, pi, sin

import numpy as np
from scipy.integrate import solve_ivp


@dataclass(frozen=True)
class Machine:
    efficiency: float = 0.85
    leak: float = 2e-11
    bulk_modulus: float = 7e8
    precharge: float = 3.5e5
    relief_crack: float = 160e5
    mass: float = 1.0
    constant_pumps: bool = False


def derivative(y, command, load_force, machine):
    x, v, p_a, p_b, omega, v_oil = y
    area_a = pi / 4 * 0.06**2
    area_b = area_a - pi / 4 * 0.03**2
    d_a, d_b = 13.03e-6 / (2 * pi), 9.35e-6 / (2 * pi)
    p_acc = machine.precharge * (1.3e-3 / (1.3e-3 - v_oil)) ** 1.3

    def leak(p):
        return machine.leak * (p - p_acc)

    def check(p):
        return 5e-9 * max(0.0, p_acc - 0.2e5 - p)

    def relief(p):
        return 3.3e-10 * max(0.0, p - p_acc - machine.relief_crack)

    def sat(p):
        return min(1.0, max(-1.0, (p - p_acc) / 1e5))

    if machine.constant_pumps:
        q_a, q_b = machine.efficiency * omega * d_a, machine.efficiency * omega * d_b
    else:
        q_a = omega * d_a - (1 - machine.efficiency) * abs(omega) * d_a * sat(p_a)
        q_b = omega * d_b + (1 - machine.efficiency) * abs(omega) * d_b * sat(p_b)

    travel = min(max(x, 0.0), 0.4)
    dp_a = (
        machine.bulk_modulus
        / (2e-6 + area_a * travel)
        * (q_a - leak(p_a) + check(p_a) - relief(p_a) - area_a * v)
    )
    flow_b = -q_b - leak(p_b) + check(p_b) - relief(p_b)
    dp_b = machine.bulk_modulus / (2e-6 + area_b * (0.4 - travel)) * (flow_b + area_b * v)
    dv_oil = -q_a + q_b + leak(p_a) + leak(p_b) - check(p_a) - check(p_b) + relief(p_a) + relief(p_b)

    d1, d2, x_t = 0.983, 0.4, 0.72 + x
    gamma = acos((d1**2 + d2**2 - x_t**2) / (2 * d1 * d2))
    turned = gamma - acos((d1**2 + d2**2 - 0.72**2) / (2 * d1 * d2))
    h = d1 * d2 * sin(gamma) / x_t
    h_slope = d1 * d2 * cos(gamma) / x_t - h**2 / x_t
    gravity = (machine.mass * 9.81) * (
        25.11 * 0.5 * sin(0.1169 + turned)
        + 21.40 * 0.977 * sin(0.1572 + turned)
        + 40.0 * 1.674 * sin(0.1775 + turned)
    )
    stop = 0.0
    if x < 0.0:
        stop = 1e8 * -x * max(0.0, 1 - 20 * v)
    elif x > 0.4:
        stop = -1e8 * (x - 0.4) * max(0.0, 1 + 20 * v)
    force = p_a * area_a - p_b * area_b - 101325.0 * (area_a - area_b) - 500.0 * v - load_force + stop
    inertia = machine.mass * 140.9
    dv = h * (force * h - gravity + inertia * h_slope * v**2 / h**3) / (inertia + 5.0 * h**2)

    target = min(max(command, -100 * pi), 100 * pi)
    d_omega = min(max((target - omega) / 5e-3, -4000.0), 4000.0)
    return [v, dv, dp_a, dp_b, d_omega, dv_oil]


def integrate(state, commands, load_forces, machine=Machine(), dt=1e-3, rtol=1e-9):
    """Return the states at the start of each period and at the end of the last, shape (n + 1, 6)."""
    states = np.empty((len(commands) + 1, 6))
    states[0] = state
    absolute = rtol * np.array([1e-4, 1e-2, 1e4, 1e4, 1e-1, 1e-8])
    for k, (command, load_force) in enumerate(zip(commands, load_forces, strict=True)):
        solution = solve_ivp(
            lambda _, y, u=float(command), f=float(load_force): derivative(y.tolist(), u, f, machine),
            (0.0, dt),
            states[k],
            method="Radau",
            rtol=rtol,
            atol=absolute,
        )
        assert solution.success, solution.message
        states[k + 1] = solution.y[:, -1]
    return states
