"""The controller's transition table: what it does, and that it does nothing else."""

from itertools import product

import pytest

from firmware_py.diagnosis import State
from firmware_py.state_machine import (
    CALIBRATED,
    DRIVE_ENABLED,
    ENABLE,
    FAULT_RESET,
    INPUTS_FRESH,
    POSITION_MOVES,
    next_state,
)

CONDITIONS = (CALIBRATED, INPUTS_FRESH, ENABLE, DRIVE_ENABLED, FAULT_RESET, POSITION_MOVES)
RUNNING = CALIBRATED | INPUTS_FRESH | ENABLE | DRIVE_ENABLED | POSITION_MOVES
ALL = RUNNING | FAULT_RESET


@pytest.mark.parametrize(
    ("state", "conditions", "target"),
    [
        (State.POWER_ON, CALIBRATED, State.STANDBY),
        (State.STANDBY, RUNNING, State.RUN),
        (State.RUN, RUNNING & ~ENABLE, State.STANDBY),
        (State.RUN, RUNNING & ~INPUTS_FRESH, State.SAFE),
        (State.RUN, RUNNING & ~DRIVE_ENABLED, State.SAFE),
        (State.RUN, RUNNING & ~POSITION_MOVES, State.SAFE),
        (State.SAFE, CALIBRATED | INPUTS_FRESH | FAULT_RESET, State.STANDBY),
    ],
)
def test_each_transition(state, conditions, target):
    assert next_state(state, conditions) == target


@pytest.mark.parametrize(
    ("state", "conditions"),
    [
        (State.POWER_ON, ALL & ~CALIBRATED),
        (State.STANDBY, ALL & ~INPUTS_FRESH),
        (State.STANDBY, ALL & ~ENABLE),
        (State.STANDBY, ALL & ~DRIVE_ENABLED),
        (State.RUN, ALL),
        (State.SAFE, ALL & ~FAULT_RESET),
        (State.SAFE, ALL & ~INPUTS_FRESH),
    ],
)
def test_what_a_state_waits_for(state, conditions):
    assert next_state(state, conditions) == state


def test_lost_inputs_weigh_more_than_a_withdrawn_enable():
    assert next_state(State.RUN, RUNNING & ~INPUTS_FRESH & ~ENABLE) == State.SAFE


def test_run_is_entered_from_standby_only_and_power_on_never_again():
    for state, bits in product(State, product((0, 1), repeat=len(CONDITIONS))):
        conditions = sum(condition for condition, bit in zip(CONDITIONS, bits, strict=True) if bit)
        target = next_state(state, conditions)
        if target == State.RUN:
            assert state in (State.STANDBY, State.RUN)
            needed = RUNNING & ~CALIBRATED & ~(POSITION_MOVES if state == State.STANDBY else 0)
            assert conditions & needed == needed
        if target == State.POWER_ON:
            assert state == State.POWER_ON
        if state == State.SAFE and target != State.SAFE:
            assert target == State.STANDBY
            assert conditions & FAULT_RESET
