"""The controller's states, and what moves it from one to the next, as data."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np


class State(IntEnum):
    """Controller state, as in ControllerStatus."""

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

READY_TO_ENABLE = ENABLE | INPUTS_FRESH


class Transition(NamedTuple):
    """Leave `source` for `target` when all of `when` and none of `unless` hold."""

    source: State
    when: int
    unless: int
    target: State


TRANSITIONS = (
    Transition(State.POWER_ON, CALIBRATED, 0, State.STANDBY),
    Transition(State.STANDBY, READY_TO_ENABLE | DRIVE_ENABLED, 0, State.RUN),
    Transition(State.RUN, 0, INPUTS_FRESH, State.SAFE),
    Transition(State.RUN, 0, ENABLE, State.STANDBY),
    Transition(State.RUN, 0, DRIVE_ENABLED, State.SAFE),
    Transition(State.SAFE, FAULT_RESET | INPUTS_FRESH, 0, State.STANDBY),
)


def next_state(state: int, conditions: int) -> int:
    """Return the target of the first transition that applies, or `state`."""
    for source, when, unless, target in TRANSITIONS:
        if source == state and conditions & when == when and not conditions & unless:
            return target
    return state


NEXT_STATE = np.array([[next_state(state, conditions) for conditions in range(32)] for state in State])
"""`next_state` as a table over states and conditions."""
