"""Conversions between the bus's units and the kernel's; the factors are correct to 2^-31."""

from dbc.machine import int32
from firmware_py.kernel.fixedpoint import mul_q, sat32


def metres_from_setpoint(setpoint: int32) -> int32:
    """0.1 um -> 2^-31 m, saturating at +-1 m (factor 2^31 / 1e7)."""
    return sat32(mul_q(setpoint, 1801439851, 23))


def metres_from_position(position: int32) -> int32:
    """1 um -> 2^-31 m, saturating at +-1 m (factor 2^31 / 1e6)."""
    return sat32(mul_q(position, 1125899907, 19))


def velocity_from_speed(speed: int32) -> int32:
    """2^-20 rad/s -> 0.25 rpm, rounded half up (factor 120 / pi / 2^20)."""
    return sat32(mul_q(speed, 1281684892, 45))


def speed_from_velocity(velocity: int32) -> int32:
    """0.25 rpm -> 2^-20 rad/s, saturating at 2048 rad/s (factor 2^20 pi / 120)."""
    return sat32(mul_q(velocity, 1799071694, 16))
