"""The control task: what one timer interrupt does with the mailboxes. Compiled; integers only."""

from enum import IntFlag

import numpy as np
from numba.extending import register_jitable

from dbc import e2e
from dbc.jit import njit
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.mailbox import CORRUPT, INVALID, IS_NEW, OVERRUNS, STALE, VALUES, poll
from firmware_py.state_machine import (
    CALIBRATED,
    DRIVE_ENABLED,
    ENABLE,
    FAULT_RESET,
    INPUTS_FRESH,
    NEXT_STATE,
    READY_TO_ENABLE,
    State,
)

# mailboxes
(FEEDBACK, SETPOINT, COMMAND, DRIVE_STATUS) = range(4)

# their signals
FEEDBACK_POSITION = VALUES + 1
SETPOINT_POSITION = VALUES
COMMAND_ENABLE, COMMAND_LAW, COMMAND_FAULT_RESET = VALUES, VALUES + 1, VALUES + 2
STATUSWORD = VALUES

# task words
(
    STATE,
    FAULTS,  # Fault bits: what is wrong now and any overrun since power-on; in the safe state what led there
    IS_CALIBRATED,
    DEFAULT_LAW,
    ARMED,  # whether a command without Enable came since power-on or the last fault
    RESET_ASKED,  # FaultReset of the last period
    SATURATIONS,  # periods in which the drive's speed limited the command
    COMMAND_COUNTER,  # E2E counter of DriveCommand
    CONTROLWORD,  # out: CiA 402 controlword
    VELOCITY,  # out: target velocity, 0.25 rpm
) = range(10)
TASK_SIZE = 10

RECORD_COLUMNS = (
    "time_ns",
    "state",
    "faults",
    "setpoint_0p1um",
    "position_um",
    "target_velocity_0p25rpm",
    "flags",
    "v1",
    "v2",
    "v3",
    "z1",
    "z2",
    "z3",
    "z4",
)
_RECORD_KERNEL_STATE = RECORD_COLUMNS.index("v1")

# where DriveCommand's layout says where its signals lie
_CONTROLWORD_START = e2e.CONFIGURATION_SIZE
_VELOCITY_START = e2e.CONFIGURATION_SIZE + 1

COUNT_MAX = 0xFFFF


class Fault(IntFlag):
    """Fault bits, in the order of ControllerStatus."""

    FEEDBACK_LOST = 1 << 0
    FEEDBACK_CORRUPT = 1 << 1
    FEEDBACK_INVALID = 1 << 2
    SETPOINT_LOST = 1 << 3
    SETPOINT_CORRUPT = 1 << 4
    SETPOINT_INVALID = 1 << 5
    COMMAND_LOST = 1 << 6
    COMMAND_CORRUPT = 1 << 7
    DRIVE_STATUS_LOST = 1 << 8
    DRIVE_STATUS_CORRUPT = 1 << 9
    DRIVE_NOT_ENABLED = 1 << 10
    DRIVE_FAULT = 1 << 11
    CALIBRATION_INVALID = 1 << 12
    MAILBOX_OVERRUN = 1 << 13


_MAILBOX_FAULTS = np.array(  # of each mailbox: lost, corrupt, invalid
    [
        (Fault.FEEDBACK_LOST, Fault.FEEDBACK_CORRUPT, Fault.FEEDBACK_INVALID),
        (Fault.SETPOINT_LOST, Fault.SETPOINT_CORRUPT, Fault.SETPOINT_INVALID),
        (Fault.COMMAND_LOST, Fault.COMMAND_CORRUPT, 0),
        (Fault.DRIVE_STATUS_LOST, Fault.DRIVE_STATUS_CORRUPT, 0),
    ],
    np.int64,
)
_DRIVE_NOT_ENABLED = int(Fault.DRIVE_NOT_ENABLED)
_DRIVE_FAULT = int(Fault.DRIVE_FAULT)
_CALIBRATION_INVALID = int(Fault.CALIBRATION_INVALID)
_MAILBOX_OVERRUN = int(Fault.MAILBOX_OVERRUN)

_STANDBY, _RUN, _SAFE = int(State.STANDBY), int(State.RUN), int(State.SAFE)

# CiA 402
DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, FAULT_RESET_BIT = 0x00, 0x02, 0x06, 0x80
_STATE_MASK = 0x6F
_OPERATION_ENABLED = 0x27
_FAULT_BIT = 0x08  # set while the fault reaction is active too
_FAULT_MASK, _IN_FAULT = 0x4F, 0x08
_ENABLING = np.array(  # statusword mask and value, the controlword that leads on from there
    [
        (_STATE_MASK, _OPERATION_ENABLED, 0x0F),
        (0x4F, 0x40, SHUTDOWN),  # switch on disabled
        (_STATE_MASK, 0x21, 0x07),  # ready to switch on
        (_STATE_MASK, 0x23, 0x0F),  # switched on
        (_STATE_MASK, 0x07, QUICK_STOP),  # quick stop active: let it finish
    ],
    np.int64,
)


@register_jitable
def _conditions(mailboxes, task):  # type: ignore[no-untyped-def]
    enable = mailboxes[COMMAND, COMMAND_ENABLE]
    reset_asked = mailboxes[COMMAND, COMMAND_FAULT_RESET]
    reset_edge = reset_asked and not task[RESET_ASKED]
    task[RESET_ASKED] = reset_asked
    if task[STATE] != _STANDBY and task[STATE] != _RUN:
        task[ARMED] = 0
    elif mailboxes[COMMAND, IS_NEW] and not enable:
        task[ARMED] = 1
    conditions = 0
    if task[IS_CALIBRATED]:
        conditions |= CALIBRATED
    if not mailboxes[:, STALE].any():
        conditions |= INPUTS_FRESH
    if enable and task[ARMED]:
        conditions |= ENABLE
    if mailboxes[DRIVE_STATUS, STATUSWORD] & _STATE_MASK == _OPERATION_ENABLED:
        conditions |= DRIVE_ENABLED
    if reset_edge:
        conditions |= FAULT_RESET
    return conditions


@register_jitable
def _faults(mailboxes, task, before):  # type: ignore[no-untyped-def]
    faults = 0
    for row in range(mailboxes.shape[0]):
        if mailboxes[row, STALE]:
            faults |= _MAILBOX_FAULTS[row, 0]
            if mailboxes[row, CORRUPT]:
                faults |= _MAILBOX_FAULTS[row, 1]
            if mailboxes[row, INVALID]:
                faults |= _MAILBOX_FAULTS[row, 2]
        if mailboxes[row, OVERRUNS]:
            faults |= _MAILBOX_OVERRUN
    if not task[IS_CALIBRATED]:
        faults |= _CALIBRATION_INVALID
    statusword = mailboxes[DRIVE_STATUS, STATUSWORD]
    if statusword & _FAULT_BIT:
        faults |= _DRIVE_FAULT
    if task[STATE] == _SAFE:
        if before == _RUN and statusword & _STATE_MASK != _OPERATION_ENABLED:
            faults |= _DRIVE_NOT_ENABLED
        faults |= task[FAULTS]
    return faults


@register_jitable
def _control(mailboxes, task, calibration, state, io, entered):  # type: ignore[no-untyped-def]
    io[k.IO_SETPOINT] = mailboxes[SETPOINT, SETPOINT_POSITION]
    io[k.IO_POSITION] = mailboxes[FEEDBACK, FEEDBACK_POSITION]
    if entered:
        law = mailboxes[COMMAND, COMMAND_LAW]
        io[k.IO_LAW] = law if law else task[DEFAULT_LAW]
        control_reset(calibration, state, io)
    control_step(calibration, state, io)
    task[VELOCITY] = io[k.IO_TARGET_VELOCITY]
    if io[k.IO_FLAGS] & k.FLAG_SPEED_LIMITED and task[SATURATIONS] < COUNT_MAX:
        task[SATURATIONS] += 1


@register_jitable
def _controlword(statusword, task, conditions):  # type: ignore[no-untyped-def]
    if task[STATE] == _SAFE:
        return QUICK_STOP
    if statusword == 0:  # the drive has not been heard of
        return DISABLE_VOLTAGE
    if statusword & _FAULT_MASK == _IN_FAULT:
        return FAULT_RESET_BIT if task[RESET_ASKED] else DISABLE_VOLTAGE
    if task[STATE] != _RUN and conditions & READY_TO_ENABLE != READY_TO_ENABLE:
        return SHUTDOWN
    for row in range(_ENABLING.shape[0]):
        if statusword & _ENABLING[row, 0] == _ENABLING[row, 1]:
            return _ENABLING[row, 2]
    return DISABLE_VOLTAGE


@njit(
    "uint64(int64[:,::1], int64[:,::1], int64[::1], int64[::1], int32[::1], int32[::1], int32[::1],"
    " int64[::1], int64)",
    depends=(
        "dbc.e2e",
        "firmware_py.compiled",
        "firmware_py.kernel",
        "firmware_py.mailbox",
        "firmware_py.state_machine",
    ),
)
def period(mailboxes, expectations, layout, task, calibration, state, io, record, now_ns):  # type: ignore[no-untyped-def]
    """Run one control period; return the protected payload of DriveCommand.

    Parameters
    ----------
    mailboxes, expectations : array of int64, a row for each mailbox
        See `firmware_py.mailbox`.
    layout : array of int64
        DriveCommand's, from `dbc.codec.MessageCodec.protected_layout`.
    task : array of int64, shape (TASK_SIZE,)
        State of the task, updated in place.
    calibration, state, io : array of int32
        The kernel's.
    record : array of int64, shape (len(RECORD_COLUMNS),)
        Filled with this period's row.
    now_ns : int
        For the record.
    """
    for row in range(mailboxes.shape[0]):
        poll(mailboxes[row], expectations[row])
    conditions = _conditions(mailboxes, task)
    before = task[STATE]
    task[STATE] = NEXT_STATE[before, conditions]
    task[FAULTS] = _faults(mailboxes, task, before)
    task[VELOCITY] = 0
    if task[STATE] == _RUN:
        _control(mailboxes, task, calibration, state, io, before != _RUN)
    task[CONTROLWORD] = _controlword(mailboxes[DRIVE_STATUS, STATUSWORD], task, conditions)
    record[0] = now_ns
    record[1] = task[STATE]
    record[2] = task[FAULTS]
    record[3] = io[k.IO_SETPOINT]
    record[4] = io[k.IO_POSITION]
    record[5] = task[VELOCITY]
    record[6] = io[k.IO_FLAGS]
    record[_RECORD_KERNEL_STATE:] = state[k.ST_V1 : k.ST_Z4 + 1]
    payload = task[CONTROLWORD] << layout[_CONTROLWORD_START]
    payload |= (task[VELOCITY] & 0xFFFF) << layout[_VELOCITY_START]
    counter = task[COMMAND_COUNTER : COMMAND_COUNTER + 1]
    return e2e.profile2_protect(counter, layout[: e2e.CONFIGURATION_SIZE], np.uint64(payload))
