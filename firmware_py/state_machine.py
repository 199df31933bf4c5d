"""The controller's states, and what moves it from one to the next, as data."""

from dbc.machine import int32

# states, as in ControllerStatus
POWER_ON = 0
STANDBY = 1
RUN = 2
SAFE = 3

# conditions: what is true in this period, one bit each
CALIBRATED = 1
INPUTS_FRESH = 2
ENABLE = 4
DRIVE_ENABLED = 8
FAULT_RESET = 16
POSITION_MOVES = 32
READY_TO_ENABLE = ENABLE | INPUTS_FRESH

# a transition: leave SOURCE for TARGET when all of WHEN and none of UNLESS hold
SOURCE = 0
WHEN = 1
UNLESS = 2
TARGET = 3

TRANSITIONS = (
    (POWER_ON, CALIBRATED, 0, STANDBY),
    (STANDBY, READY_TO_ENABLE | DRIVE_ENABLED, 0, RUN),
    (RUN, 0, INPUTS_FRESH, SAFE),
    (RUN, 0, POSITION_MOVES, SAFE),
    (RUN, 0, ENABLE, STANDBY),
    (RUN, 0, DRIVE_ENABLED, SAFE),
    (SAFE, FAULT_RESET | INPUTS_FRESH, 0, STANDBY),
)


def next_state(state: int32, conditions: int32) -> int32:
    """Target of the first transition that applies, or `state`."""
    for row in range(len(TRANSITIONS)):
        when = TRANSITIONS[row][WHEN]
        unless = conditions & TRANSITIONS[row][UNLESS]
        if TRANSITIONS[row][SOURCE] == state and (conditions & when) == when and unless == 0:
            return TRANSITIONS[row][TARGET]
    return state
