"""Supervision of the motion: a position that stays where it is while the motor is told to turn fast.

Either the sensor is stuck or the rod is blocked; the controller would drive on in both cases.
"""

from dbc.machine import Array32, i32, i64, int32
from firmware_py.kernel.fixedpoint import absolute
from firmware_py.state_machine import RUN
from firmware_py.task_layout import STATE, STILL_PERIODS, STILL_POSITION, VELOCITY

FAST = 6000  # in 0.25 rpm; half the drive's speed: holding a load against the pumps' leaks takes less
MOTION = 1000  # in um
STUCK_PERIODS = 50


def watch_motion(task: Array32, position: int32) -> None:
    """Count the periods since the `position` (um) last moved by more than MOTION, or the motor was slow."""
    moved = absolute(i64(position) - i64(task[STILL_POSITION]))
    if task[STATE] != RUN or moved > MOTION or absolute(i64(task[VELOCITY])) < FAST:
        task[STILL_POSITION] = position
        task[STILL_PERIODS] = 0
    else:
        task[STILL_PERIODS] = i32(task[STILL_PERIODS] + 1)
