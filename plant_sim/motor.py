"""The servo motor's speed loop: first-order lag with limited acceleration and speed."""

import numpy as np
from numba.extending import register_jitable

from plant_sim import layout as at


@register_jitable
def decay_over(elapsed, p):  # type: ignore[no-untyped-def]
    """Share of a small speed error that is left after `elapsed` seconds."""
    return np.exp(-elapsed / p[at.MOTOR_TIME_CONSTANT])


@register_jitable
def speed_after(speed, command, elapsed, decay, p):  # type: ignore[no-untyped-def]
    """Exact motor speed in rad/s after `elapsed` seconds of a constant command.

    Solves dω/dt = clip((command - ω)/τ, ±acceleration) with the command clipped to the motor's top speed:
    a ramp while the difference exceeds acceleration · τ, then an exponential. `decay` is
    ``decay_over(elapsed, p)``, computed once by the caller for its many equal steps.
    """
    acceleration = p[at.MOTOR_MAX_ACCELERATION]
    target = min(max(command, -p[at.MOTOR_MAX_SPEED]), p[at.MOTOR_MAX_SPEED])
    gap = target - speed
    excess_gap = np.abs(gap) - acceleration * p[at.MOTOR_TIME_CONSTANT]
    if excess_gap <= 0.0:
        return target - gap * decay
    if excess_gap >= acceleration * elapsed:
        return speed + np.copysign(acceleration * elapsed, gap)
    linear_gap = np.copysign(acceleration * p[at.MOTOR_TIME_CONSTANT], gap)
    return target - linear_gap * decay_over(elapsed - excess_gap / acceleration, p)
