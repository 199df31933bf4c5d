"""Reference positions as pure functions of time."""

from collections.abc import Callable

import numpy as np

SETPOINT_LSB_M = 1e-7
"""Resolution of the setpoint on the bus, m."""

STROKE_AMPLITUDE_M = 0.15
LIFT_LOWER_ACCELERATION_M_S2 = 0.75
LIFT_LOWER_TARGETS = (  # s, m/s: from this time on, this velocity is aimed at
    (0.3, 0.05),
    (3.1, 0.0),
    (3.4, -0.10),
    (4.8, 0.0),
    (6.15, 0.05),
    (7.85, 0.0),
    (8.15, -0.10),
    (9.0, 0.0),
)
FULL_STROKE_MOVES = (  # start s, end s, from m, to m
    (0.3, 6.3, 0.0, 0.38),
    (6.7, 7.8, 0.38, 0.33),
    (8.1, 13.6, 0.33, 0.0003),
)


def sine(time_s: np.ndarray) -> np.ndarray:
    """Return eq. 28, in m: 0.15 sin(0.2 pi t - pi/2) + 0.15, from 0 at rest to 0.3 and back in 10 s."""
    return STROKE_AMPLITUDE_M * (1.0 - np.cos(0.2 * np.pi * time_s))


def lift_lower(time_s: np.ndarray) -> np.ndarray:
    """Return two lifts and lowerings, in m, 10.5 s.

    Stands in for the paper's unpublished "actual working position" signal. Each new velocity target is
    approached with constant acceleration, so that every move covers its target velocity times its duration.
    """
    position = np.zeros_like(time_s)
    velocity = 0.0
    for start_s, target_m_s in LIFT_LOWER_TARGETS:
        change = target_m_s - velocity
        ramp_s = abs(change) / LIFT_LOWER_ACCELERATION_M_S2
        elapsed = np.maximum(time_s - start_s, 0.0)
        ramping = np.minimum(elapsed, ramp_s)
        position += change / ramp_s * ramping**2 / 2 + change * (elapsed - ramping)
        velocity = target_m_s
    return position


def full_stroke(time_s: np.ndarray) -> np.ndarray:
    """Return quintic moves over the whole stroke, in m, 15 s."""
    position = np.zeros_like(time_s)
    for start_s, end_s, from_m, to_m in FULL_STROKE_MOVES:
        s = np.clip((time_s - start_s) / (end_s - start_s), 0.0, 1.0)
        position += (to_m - from_m) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return position


REFERENCES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sine": sine,
    "lift_lower": lift_lower,
    "full_stroke": full_stroke,
}


def setpoint_counts(reference_m: np.ndarray) -> np.ndarray:
    """Return the reference as setpoint counts of 0.1 um, int32."""
    return np.rint(reference_m / SETPOINT_LSB_M).astype(np.int32)
