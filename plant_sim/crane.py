"""The micro-crane seen from the piston rod: geometry and inertia, eqs 9-17."""

import numpy as np
from numba.extending import register_jitable

from plant_sim import layout as at


@register_jitable
def geometry(position, p):  # type: ignore[no-untyped-def]
    """Solve the triangle of cylinder and boom for one rod position (eqs 15-17).

    Parameters
    ----------
    position : float
        Rod position x in m; x_t = x_t0 + x.
    p : ndarray
        Parameter vector, see `plant_sim.layout`.

    Returns
    -------
    cos_gamma, sin_gamma : float
        Of the angle γ between d1 and d2.
    lever : float
        h = dx/dγ = d1 sin α in m.
    lever_slope : float
        dh/dγ in m.
    """
    length = p[at.RETRACTED_LENGTH] + position
    product = p[at.LENGTH_PRODUCT]
    per_length = 1.0 / length
    cos_gamma = (p[at.LENGTH_SQUARES] - length * length) / (2.0 * product)
    sin_gamma = np.sqrt(1.0 - cos_gamma * cos_gamma)
    lever = product * sin_gamma * per_length
    lever_slope = (product * cos_gamma - lever * lever) * per_length
    return cos_gamma, sin_gamma, lever, lever_slope


@register_jitable
def rod_dynamics(position, p):  # type: ignore[no-untyped-def]
    """Reduce the torque balance (9), (10) to the rod: m(x) v̇ = F - F_g(x) + c(x) v².

    Equation (10) is used with the load's lever arm r_load, which the printed form lacks.

    Returns
    -------
    effective_mass : float
        J/h² + m_p in kg.
    gravity_force : float
        G/h in N, > 0 pushes the rod in.
    centripetal : float
        c = J h'/h⁴ in kg/m.
    """
    cos_gamma, sin_gamma, lever, lever_slope = geometry(position, p)
    per_lever = 1.0 / lever
    per_lever_squared = per_lever * per_lever
    effective_mass = p[at.INERTIA] * per_lever_squared + p[at.PISTON_MASS]
    gravity_force = (p[at.GRAVITY_SIN] * sin_gamma + p[at.GRAVITY_COS] * cos_gamma) * per_lever
    centripetal = p[at.INERTIA] * lever_slope * per_lever_squared * per_lever_squared
    return effective_mass, gravity_force, centripetal


@register_jitable
def end_stop(position, velocity, p):  # type: ignore[no-untyped-def]
    """Force of the end stops on the rod, k · penetration · max(0, 1 + d · approach speed).

    Returns
    -------
    force : float
        N, > 0 pushes the rod out.
    position_slope, velocity_slope : float
        Its derivatives in N/m and N s/m.
    """
    stiffness = p[at.STOP_STIFFNESS]
    damping = p[at.STOP_DAMPING]
    if position < 0.0 and damping * velocity < 1.0:
        factor = stiffness * (1.0 - damping * velocity)
        return -position * factor, -factor, stiffness * damping * position
    overtravel = position - p[at.STROKE]
    if overtravel > 0.0 and damping * velocity > -1.0:
        factor = stiffness * (1.0 + damping * velocity)
        return -overtravel * factor, -factor, -stiffness * damping * overtravel
    return 0.0, 0.0, 0.0
