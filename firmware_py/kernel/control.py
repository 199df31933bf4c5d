"""Entry points: `control_reset` before the first tick, `control_step` once per 1 ms tick."""

from dbc.machine import Array32, i32, i64, int32
from firmware_py.kernel.adrc import adrc_reset, adrc_step
from firmware_py.kernel.command_filter import command_filter_reset, command_filter_step
from firmware_py.kernel.fixedpoint import clamp
from firmware_py.kernel.front_end import front_end_reset
from firmware_py.kernel.layout import (
    CAL_U_LIMIT,
    FLAG_SETPOINT_LIMITED,
    FLAG_SPEED_LIMITED,
    FLAG_STATE_SATURATED,
    IO_FLAGS,
    IO_LAW,
    IO_POSITION,
    IO_SATURATIONS,
    IO_SETPOINT,
    IO_TARGET_VELOCITY,
    LAW_ADRC,
    LAW_P,
    LAW_PI,
    LAW_PI_FF,
    LAW_SCHEDULED,
    ST_LAW,
    ST_SATURATIONS,
    ST_U,
)
from firmware_py.kernel.limiter import limiter_reset, limiter_step
from firmware_py.kernel.pi import p_step, pi_ff_step, pi_reset, pi_step
from firmware_py.kernel.scheduled import scheduled_reset, scheduled_step
from firmware_py.kernel.units import (
    metres_from_position,
    metres_from_setpoint,
    speed_from_velocity,
    velocity_from_speed,
)


def law_reset(state: Array32, position: int32) -> None:
    """Start every law at rest at `position` (2^-31 m)."""
    adrc_reset(state, position)
    pi_reset(state)
    front_end_reset(state, position)
    scheduled_reset(state)
    command_filter_reset(state)


def control_reset(calibration: Array32, state: Array32, io: Array32) -> None:
    """Start without a bump: limiter, differentiator and observer at the measured position, at rest."""
    position = metres_from_position(io[IO_POSITION])
    limiter_reset(state, position)
    law_reset(state, position)
    state[ST_LAW] = io[IO_LAW]
    state[ST_SATURATIONS] = 0
    state[ST_U] = 0
    io[IO_TARGET_VELOCITY] = 0
    io[IO_FLAGS] = 0
    io[IO_SATURATIONS] = 0


def law_step(calibration: Array32, state: Array32, setpoint: int32, position: int32) -> int32:
    """Wanted speed (2^-20 rad/s) of the law chosen; standstill for an unknown one."""
    if state[ST_LAW] == LAW_ADRC:
        return adrc_step(calibration, state, setpoint, position)
    if state[ST_LAW] == LAW_PI:
        return pi_step(calibration, state, setpoint, position, 0)
    if state[ST_LAW] == LAW_P:
        return p_step(calibration, setpoint, position)
    if state[ST_LAW] == LAW_SCHEDULED:
        return command_filter_step(calibration, state, scheduled_step(calibration, state, setpoint, position))
    if state[ST_LAW] == LAW_PI_FF:
        return command_filter_step(calibration, state, pi_ff_step(calibration, state, setpoint, position))
    return 0


def control_step(calibration: Array32, state: Array32, io: Array32) -> None:
    """Limit the setpoint, run the law, clip to the drive's speed, quantise to 0.25 rpm.

    A change of law starts the new one at rest at the measured position.
    """
    setpoint = metres_from_setpoint(io[IO_SETPOINT])
    position = metres_from_position(io[IO_POSITION])
    saturations = state[ST_SATURATIONS]
    if state[ST_LAW] != io[IO_LAW]:
        law_reset(state, position)
        state[ST_LAW] = io[IO_LAW]
    limited = limiter_step(calibration, state, setpoint)
    wanted = law_step(calibration, state, limited, position)
    u = i32(clamp(i64(wanted), i64(calibration[CAL_U_LIMIT])))
    velocity = velocity_from_speed(u)
    state[ST_U] = speed_from_velocity(velocity)
    flags = 0
    if wanted != u:
        flags = flags + FLAG_SPEED_LIMITED
    if limited != setpoint:
        flags = flags + FLAG_SETPOINT_LIMITED
    if state[ST_SATURATIONS] != saturations:
        flags = flags + FLAG_STATE_SATURATED
    io[IO_TARGET_VELOCITY] = velocity
    io[IO_FLAGS] = flags
    io[IO_SATURATIONS] = state[ST_SATURATIONS]
