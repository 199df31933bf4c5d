"""Names for what the controller reports: its states and its fault bits."""

from enum import IntEnum, IntFlag

from firmware_py import state_machine
from firmware_py import task_layout as at


class State(IntEnum):
    """Controller state, as in ControllerStatus."""

    POWER_ON = state_machine.POWER_ON
    STANDBY = state_machine.STANDBY
    RUN = state_machine.RUN
    SAFE = state_machine.SAFE


class Fault(IntFlag):
    """Fault bits, in the order of ControllerStatus."""

    FEEDBACK_LOST = at.FEEDBACK_LOST
    FEEDBACK_CORRUPT = at.FEEDBACK_CORRUPT
    FEEDBACK_INVALID = at.FEEDBACK_INVALID
    SETPOINT_LOST = at.SETPOINT_LOST
    SETPOINT_CORRUPT = at.SETPOINT_CORRUPT
    SETPOINT_INVALID = at.SETPOINT_INVALID
    COMMAND_LOST = at.COMMAND_LOST
    COMMAND_CORRUPT = at.COMMAND_CORRUPT
    DRIVE_STATUS_LOST = at.DRIVE_STATUS_LOST
    DRIVE_STATUS_CORRUPT = at.DRIVE_STATUS_CORRUPT
    DRIVE_NOT_ENABLED = at.DRIVE_NOT_ENABLED
    DRIVE_FAULT = at.DRIVE_FAULT
    CALIBRATION_INVALID = at.CALIBRATION_INVALID
    MAILBOX_OVERRUN = at.MAILBOX_OVERRUN
    POSITION_STUCK = at.POSITION_STUCK
