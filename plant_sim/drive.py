"""CiA 402 drive in cyclic synchronous velocity mode, without the frames that carry it.

The state machine is two tables: what a controlword means, and which transition it triggers. Numbers in
comments are CiA 402's transition numbers. A quick stop ramps down, then disables (option code 2); losing the
command ramps down, then faults. Leaving Operation enabled any other way sets the speed command to zero at
once, and the motor follows at its own acceleration limit.

A drive may take its commands later than at the first cycle after their arrival: one or two cycles more, which
they spend in a queue, periods without a command among them.
"""

import math
from enum import IntEnum

import numpy as np
from numba.extending import register_jitable

from dbc.jit import njit

COUNTS_PER_RPM = 4
"""Target velocity is in 0.25 rpm."""
PERIOD_S = 1e-3
MISSED_COMMANDS_LIMIT = 3
"""Consecutive periods without a valid command that trip an enabled drive."""
MAX_DELAY_PERIODS = 3
"""Largest transport delay: commands wait for up to two cycles."""

RAD_S_PER_COUNT = math.pi / (30.0 * COUNTS_PER_RPM)


class State(IntEnum):
    """Drive states; the value is the statusword's state bits (0, 1, 2, 3, 5, 6)."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(IntEnum):
    """What a controlword asks for."""

    SHUTDOWN = 0
    SWITCH_ON = 1
    ENABLE_OPERATION = 2
    DISABLE_VOLTAGE = 3
    QUICK_STOP = 4


class StatusBit(IntEnum):
    """Statusword 0x6041 bits beside the state."""

    VOLTAGE_ENABLED = 0x0010
    REMOTE = 0x0200
    INTERNAL_LIMIT = 0x0800
    FOLLOWS_COMMAND = 0x1000


FAULT_RESET = 0x80
"""Controlword bit 7; its rising edge resets a fault."""

_COMMAND_MASKS = (  # mask, value, command: the first match counts
    (0x02, 0x00, Command.DISABLE_VOLTAGE),
    (0x06, 0x02, Command.QUICK_STOP),
    (0x07, 0x06, Command.SHUTDOWN),
    (0x0F, 0x07, Command.SWITCH_ON),
    (0x0F, 0x0F, Command.ENABLE_OPERATION),
)

_TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 2
    (State.READY_TO_SWITCH_ON, Command.SWITCH_ON): State.SWITCHED_ON,  # 3
    (State.READY_TO_SWITCH_ON, Command.ENABLE_OPERATION): State.SWITCHED_ON,  # 3, then 4 one period later
    (State.READY_TO_SWITCH_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 7
    (State.READY_TO_SWITCH_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 7
    (State.SWITCHED_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,  # 4
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 6
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 10
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 10
    (State.OPERATION_ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,  # 5
    (State.OPERATION_ENABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 8
    (State.OPERATION_ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 9
    (State.OPERATION_ENABLED, Command.QUICK_STOP): State.QUICK_STOP_ACTIVE,  # 11
    (State.QUICK_STOP_ACTIVE, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 12
}

_AFTER_RAMP = {
    State.QUICK_STOP_ACTIVE: State.SWITCH_ON_DISABLED,  # 12
    State.FAULT_REACTION_ACTIVE: State.FAULT,  # 14
}


_COMMANDS = tuple(
    next(command for mask, value, command in _COMMAND_MASKS if bits & mask == value) for bits in range(16)
)


def decode_controlword(controlword: int) -> Command:
    """Return what controlword 0x6040 asks for, fault reset aside."""
    return _COMMANDS[controlword & 0x0F]


# the tables over state and controlword bits 0..3; rows of no state are not used
_NEXT_STATE = np.zeros((max(State) + 1, 16), np.int64)
_NEXT_AFTER_RAMP = np.full(max(State) + 1, -1, np.int64)
for _state in State:
    for _bits in range(16):
        _NEXT_STATE[_state, _bits] = _TRANSITIONS.get((_state, decode_controlword(_bits)), _state)
    _NEXT_AFTER_RAMP[_state] = _AFTER_RAMP.get(_state, -1)

_NOT_READY = int(State.NOT_READY_TO_SWITCH_ON)
_DISABLED = int(State.SWITCH_ON_DISABLED)
_ENABLED = int(State.OPERATION_ENABLED)
_REACTING = int(State.FAULT_REACTION_ACTIVE)
_FAULT = int(State.FAULT)

# words of a drive
(
    STATE,
    SPEED_COUNTS,  # speed command, 0.25 rpm
    LIMITED,  # whether the last target was beyond the top speed
    MISSED,  # periods in a row without a valid command
    RESET_BIT,  # controlword bit 7 of the last command
    MAX_COUNTS,  # top speed, 0.25 rpm
    RAMP_COUNTS,  # slope of a stop, 0.25 rpm per period
    WAIT,  # cycles that a command waits
    OLDEST,  # which of the waiting commands is the next to be taken
    QUEUE,  # from here on the waiting commands: controlword, target, whether there is one
) = range(10)
_COMMAND_SIZE = 3
DRIVE_SIZE = QUEUE + _COMMAND_SIZE * (MAX_DELAY_PERIODS - 1)


@register_jitable
def _after_waiting(drive, controlword, target, arrived):  # type: ignore[no-untyped-def]
    """Put this period's command into the queue and return the one whose turn it is."""
    if drive[WAIT] == 0:
        return controlword, target, arrived
    place = QUEUE + _COMMAND_SIZE * drive[OLDEST]
    drive[OLDEST] = (drive[OLDEST] + 1) % drive[WAIT]
    taken = drive[place], drive[place + 1], drive[place + 2]
    drive[place], drive[place + 1], drive[place + 2] = controlword, target, arrived
    return taken


@njit("float64(int64[::1], int64, int64, int64)")
def drive_step(drive, controlword, target, arrived):  # type: ignore[no-untyped-def]
    """Run one drive period on a drive's words; see `Drive.step`. `arrived` is 0 without a valid command."""
    controlword, target, arrived = _after_waiting(drive, controlword, target, arrived)
    if drive[STATE] == _NOT_READY:
        drive[STATE] = _DISABLED  # 0, 1
    if arrived:
        drive[MISSED] = 0
        reset_bit = controlword & FAULT_RESET
        rising = reset_bit > drive[RESET_BIT]
        drive[RESET_BIT] = reset_bit
        if drive[STATE] == _FAULT and rising:
            drive[STATE] = _DISABLED  # 15
        elif not reset_bit:
            drive[STATE] = _NEXT_STATE[drive[STATE], controlword & 0x0F]
    elif drive[STATE] == _ENABLED:
        drive[MISSED] += 1
        if drive[MISSED] >= MISSED_COMMANDS_LIMIT:
            drive[STATE] = _REACTING  # 13
    if _NEXT_AFTER_RAMP[drive[STATE]] >= 0:
        remaining = max(abs(drive[SPEED_COUNTS]) - drive[RAMP_COUNTS], 0)
        drive[SPEED_COUNTS] = remaining if drive[SPEED_COUNTS] > 0 else -remaining
        if remaining == 0:
            drive[STATE] = _NEXT_AFTER_RAMP[drive[STATE]]
    elif drive[STATE] != _ENABLED:
        drive[SPEED_COUNTS] = 0
    elif arrived:
        drive[SPEED_COUNTS] = min(max(target, -drive[MAX_COUNTS]), drive[MAX_COUNTS])
        drive[LIMITED] = drive[SPEED_COUNTS] != target
    return drive[SPEED_COUNTS] * RAD_S_PER_COUNT


class Drive:
    """The drive's state machine, command supervision and speed command.

    Supervision runs in Operation enabled only: before the first valid command and in every other state
    nothing moves, or is already being stopped, so there is nothing to protect. A missed command holds the
    last target; the third in a row starts the fault reaction.

    Parameters
    ----------
    max_speed_rpm : float
        Targets beyond it are limited and reported as internal limit.
    deceleration_rad_s2 : float
        Slope of quick stop and fault reaction.
    delay_periods : int
        1 to `MAX_DELAY_PERIODS`; with 1 a command is taken at the first cycle after its arrival.

    Attributes
    ----------
    words : array of int64, shape (DRIVE_SIZE,)
        What `drive_step` works on.
    """

    def __init__(
        self, max_speed_rpm: float = 3000.0, deceleration_rad_s2: float = 4000.0, delay_periods: int = 1
    ) -> None:
        if not 1 <= delay_periods <= MAX_DELAY_PERIODS:
            raise ValueError(f"delay_periods is {delay_periods}, must be from 1 to {MAX_DELAY_PERIODS}")
        self.words = np.zeros(DRIVE_SIZE, np.int64)
        self.words[STATE] = State.NOT_READY_TO_SWITCH_ON
        self.words[MAX_COUNTS] = int(max_speed_rpm * COUNTS_PER_RPM)
        self.words[RAMP_COUNTS] = max(1, int(deceleration_rad_s2 * PERIOD_S / RAD_S_PER_COUNT))
        self.words[WAIT] = delay_periods - 1

    @property
    def state(self) -> State:
        """State of the state machine."""
        return State(int(self.words[STATE]))

    @property
    def statusword(self) -> int:
        """Statusword 0x6041."""
        word = self.state | StatusBit.VOLTAGE_ENABLED | StatusBit.REMOTE
        if self.state == State.OPERATION_ENABLED:
            word |= StatusBit.FOLLOWS_COMMAND
            if self.words[LIMITED]:
                word |= StatusBit.INTERNAL_LIMIT
        return word

    def step(self, command: tuple[int, int] | None) -> float:
        """Run one drive period.

        Parameters
        ----------
        command : tuple of int, or None
            (controlword, target velocity in 0.25 rpm) of the newest valid command since the last period.

        Returns
        -------
        speed_command_rad_s : float
            For the motor, held until the next step.
        """
        controlword, target = command or (0, 0)
        speed_rad_s: float = drive_step(self.words, controlword, target, command is not None)
        return speed_rad_s
