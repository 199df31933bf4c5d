"""CiA 402 drive in cyclic synchronous velocity mode, without the frames that carry it.

The state machine is two tables: what a controlword means, and which transition it triggers. Numbers in
comments are CiA 402's transition numbers. A quick stop ramps down, then disables (option code 2); losing the
command ramps down, then faults. Leaving Operation enabled any other way sets the speed command to zero at
once, and the motor follows at its own acceleration limit.
"""

import math
from enum import IntEnum

COUNTS_PER_RPM = 4
"""Target velocity is in 0.25 rpm."""
PERIOD_S = 1e-3
MISSED_COMMANDS_LIMIT = 3
"""Consecutive periods without a valid command that trip an enabled drive."""

_RAD_S_PER_COUNT = math.pi / (30.0 * COUNTS_PER_RPM)


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

    Attributes
    ----------
    state : State
    """

    def __init__(self, max_speed_rpm: float = 3000.0, deceleration_rad_s2: float = 4000.0) -> None:
        self._max_counts = int(max_speed_rpm * COUNTS_PER_RPM)
        self._ramp_counts = max(1, int(deceleration_rad_s2 * PERIOD_S / _RAD_S_PER_COUNT))
        self.state = State.NOT_READY_TO_SWITCH_ON
        self._speed_counts = 0
        self._limited = False
        self._missed = 0
        self._reset_bit = 0

    @property
    def statusword(self) -> int:
        """Statusword 0x6041."""
        word = self.state | StatusBit.VOLTAGE_ENABLED | StatusBit.REMOTE
        if self.state == State.OPERATION_ENABLED:
            word |= StatusBit.FOLLOWS_COMMAND
            if self._limited:
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
        if self.state == State.NOT_READY_TO_SWITCH_ON:
            self.state = State.SWITCH_ON_DISABLED  # 0, 1
        if command is None:
            self._supervise()
        else:
            self._missed = 0
            self._obey(command[0])
        self._set_speed(command)
        return self._speed_counts * _RAD_S_PER_COUNT

    def _supervise(self) -> None:
        if self.state != State.OPERATION_ENABLED:
            return
        self._missed += 1
        if self._missed >= MISSED_COMMANDS_LIMIT:
            self._missed = 0
            self.state = State.FAULT_REACTION_ACTIVE  # 13

    def _obey(self, controlword: int) -> None:
        reset_bit = controlword & FAULT_RESET
        rising = reset_bit > self._reset_bit
        self._reset_bit = reset_bit
        if self.state == State.FAULT and rising:
            self.state = State.SWITCH_ON_DISABLED  # 15
        elif not reset_bit:
            self.state = _TRANSITIONS.get((self.state, decode_controlword(controlword)), self.state)

    def _set_speed(self, command: tuple[int, int] | None) -> None:
        if self.state in _AFTER_RAMP:
            remaining = max(abs(self._speed_counts) - self._ramp_counts, 0)
            self._speed_counts = remaining if self._speed_counts > 0 else -remaining
            if remaining == 0:
                self.state = _AFTER_RAMP[self.state]
        elif self.state != State.OPERATION_ENABLED:
            self._speed_counts = 0
        elif command is not None:
            target = command[1]
            self._speed_counts = min(max(target, -self._max_counts), self._max_counts)
            self._limited = self._speed_counts != target
