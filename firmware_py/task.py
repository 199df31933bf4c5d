"""The control task: what the receive and timer interrupts do.

`state`, `io` and `calibration` are the kernel's, see `firmware_py.kernel.layout`; for the other arrays see
`firmware_py.task_layout`. A payload is two 32-bit words, byte 0 in the low eight bits of `low`.
"""

from dbc.machine import Array32, i32, int32
from dbc.profile2 import MAX_COUNTER, profile2_protect
from firmware_py.calibration_block import law_of_block
from firmware_py.kernel.control import control_reset, control_step
from firmware_py.kernel.layout import (
    FLAG_SPEED_LIMITED,
    IO_FLAGS,
    IO_LAW,
    IO_POSITION,
    IO_SETPOINT,
    IO_SIZE,
    IO_TARGET_VELOCITY,
    ST_SIZE,
    ST_V1,
)
from firmware_py.mailbox import clear, poll, take
from firmware_py.signals import begin, extract, insert
from firmware_py.state_machine import (
    CALIBRATED,
    DRIVE_ENABLED,
    ENABLE,
    FAULT_RESET,
    INPUTS_FRESH,
    POSITION_MOVES,
    READY_TO_ENABLE,
    RUN,
    SAFE,
    STANDBY,
    next_state,
)
from firmware_py.supervision import STUCK_PERIODS, watch_motion
from firmware_py.task_layout import (
    ARMED,
    BENCH_COMMAND,
    BENCH_CONTROL,
    CALIBRATION_INVALID,
    COMMAND,
    COMMAND_CORRUPT,
    COMMAND_COUNTER,
    COMMAND_ENABLE,
    COMMAND_FAULT_RESET,
    COMMAND_LAW,
    COMMAND_LOST,
    CONTROLLER_STATUS,
    CONTROLWORD,
    CORRUPT,
    COUNT_MAX,
    CYCLE,
    DEFAULT_LAW,
    DRIVE_COMMAND,
    DRIVE_FAULT,
    DRIVE_NOT_ENABLED,
    DRIVE_STATUS_CORRUPT,
    DRIVE_STATUS_LOST,
    EXECUTION_TIME,
    EXPECTATION_SIZE,
    EXPECTED_ID,
    FAULT_COUNT,
    FAULTS,
    FEEDBACK_CORRUPT,
    FEEDBACK_INVALID,
    FEEDBACK_LOST,
    FEEDBACK_POSITION,
    FRAME_HIGH,
    FRAME_LOW,
    FRAME_SIZE,
    INVALID,
    IS_NEW,
    MAILBOX_OVERRUN,
    MAILBOX_SIZE,
    MAILBOXES,
    MESSAGE_ID,
    OBSERVER_PAGE,
    OBSERVER_PHASE,
    OBSERVER_STATE,
    OVERRUNS,
    POSITION_STUCK,
    PROTECTION,
    RESET_ASKED,
    RESTART_ASKED,
    SATURATIONS,
    SENT_CONTROLWORD,
    SENT_CYCLE,
    SENT_EXECUTION_TIME,
    SENT_FAULTS,
    SENT_LAW,
    SENT_OVERRUNS,
    SENT_PAGE,
    SENT_SATURATIONS,
    SENT_STATE,
    SENT_VALUE,
    SENT_VELOCITY,
    SETPOINT_CORRUPT,
    SETPOINT_INVALID,
    SETPOINT_LOST,
    SETPOINT_POSITION,
    SIGNAL_SIZE,
    STALE,
    STATE,
    STATUS_PHASE,
    STATUSWORD,
    STILL_PERIODS,
    TASK_SIZE,
    VELOCITY,
)

ASSUMED_EXECUTION_TIME = 20  # 0.5 %
STATUS_PERIODS = 100
OBSERVER_PERIODS = 10
OBSERVER_DUE = 7  # its phase
OBSERVER_PAGES = 7
BENCH_RESET = 1  # BenchControl's command

# faults of each mailbox
IF_LOST = 0
IF_CORRUPT = 1
IF_INVALID = 2
MAILBOX_FAULTS = (
    (FEEDBACK_LOST, FEEDBACK_CORRUPT, FEEDBACK_INVALID),
    (SETPOINT_LOST, SETPOINT_CORRUPT, SETPOINT_INVALID),
    (COMMAND_LOST, COMMAND_CORRUPT, 0),
    (DRIVE_STATUS_LOST, DRIVE_STATUS_CORRUPT, 0),
)

# CiA 402: controlwords, masks and values of the statusword
DISABLE_VOLTAGE = 0x00
QUICK_STOP = 0x02
SHUTDOWN = 0x06
SWITCH_ON = 0x07
ENABLE_OPERATION = 0x0F
RESET_FAULT = 0x80
STATE_MASK = 0x6F
OPERATION_ENABLED = 0x27
FAULT_BIT = 0x08  # set while the fault reaction is active too
FAULT_MASK = 0x4F
IN_FAULT = 0x08

# mask and value of the statusword, and the controlword that leads on from there
MASK = 0
VALUE = 1
LEADS_ON = 2
ENABLING = (
    (STATE_MASK, OPERATION_ENABLED, ENABLE_OPERATION),
    (0x4F, 0x40, SHUTDOWN),  # switch on disabled
    (STATE_MASK, 0x21, SWITCH_ON),  # ready to switch on
    (STATE_MASK, 0x23, ENABLE_OPERATION),  # switched on
    (STATE_MASK, 0x07, QUICK_STOP),  # quick stop active: let it finish
)


def empty(contract: Array32, mailboxes: Array32) -> None:
    """Empty all mailboxes."""
    mailbox = 0
    expected = 0
    for _row in range(MAILBOXES):
        clear(mailboxes, mailbox, contract, expected)
        mailbox = mailbox + MAILBOX_SIZE
        expected = expected + EXPECTATION_SIZE


def restart(task: Array32, state: Array32, io: Array32) -> None:
    """Begin as after power-on; what is known of calibration and execution time stays."""
    law = task[DEFAULT_LAW]
    execution_time = task[EXECUTION_TIME]
    for word in range(TASK_SIZE):
        task[word] = 0
    for word in range(ST_SIZE):
        state[word] = 0
    for word in range(IO_SIZE):
        io[word] = 0
    task[DEFAULT_LAW] = law
    task[EXECUTION_TIME] = execution_time


def power_on(
    contract: Array32, mailboxes: Array32, task: Array32, block: Array32, state: Array32, io: Array32
) -> None:
    """Power-on: check the calibration as flashed, forget everything."""
    task[DEFAULT_LAW] = law_of_block(block)
    task[EXECUTION_TIME] = ASSUMED_EXECUTION_TIME
    empty(contract, mailboxes)
    restart(task, state, io)


def receive(
    contract: Array32,
    mailboxes: Array32,
    task: Array32,
    can_id: int32,
    length: int32,
    low: int32,
    high: int32,
) -> None:
    """Receive interrupt: latch. A reset forgets what came before it, not what comes after."""
    mailbox = 0
    expected = 0
    for _row in range(MAILBOXES):
        if can_id == contract[expected + EXPECTED_ID]:
            take(mailboxes, mailbox, length, low, high)
        mailbox = mailbox + MAILBOX_SIZE
        expected = expected + EXPECTATION_SIZE
    bit = contract[BENCH_COMMAND]
    bits = contract[BENCH_COMMAND + 1]
    if can_id == contract[BENCH_CONTROL + MESSAGE_ID] and extract(low, high, bit, bits, 0) == BENCH_RESET:
        empty(contract, mailboxes)
        task[RESTART_ASKED] = 1


def conditions_of(mailboxes: Array32, task: Array32) -> int32:
    """Conditions of the state machine; moves `task`'s ARMED and RESET_ASKED on."""
    enable = mailboxes[COMMAND_ENABLE]
    reset_asked = mailboxes[COMMAND_FAULT_RESET]
    conditions = 0
    if reset_asked != 0 and task[RESET_ASKED] == 0:
        conditions = conditions | FAULT_RESET
    task[RESET_ASKED] = reset_asked
    if task[STATE] != STANDBY and task[STATE] != RUN:
        task[ARMED] = 0
    elif mailboxes[COMMAND + IS_NEW] != 0 and enable == 0:
        task[ARMED] = 1
    if task[DEFAULT_LAW] != 0:
        conditions = conditions | CALIBRATED
    stale = 0
    mailbox = 0
    for _row in range(MAILBOXES):
        stale = stale | mailboxes[mailbox + STALE]
        mailbox = mailbox + MAILBOX_SIZE
    if stale == 0:
        conditions = conditions | INPUTS_FRESH
    if enable != 0 and task[ARMED] != 0:
        conditions = conditions | ENABLE
    if (mailboxes[STATUSWORD] & STATE_MASK) == OPERATION_ENABLED:
        conditions = conditions | DRIVE_ENABLED
    if task[STILL_PERIODS] < STUCK_PERIODS:
        conditions = conditions | POSITION_MOVES
    return conditions


def faults_of(mailboxes: Array32, task: Array32, before: int32) -> int32:
    """Fault bits; `before` is the state of the last period."""
    faults = 0
    mailbox = 0
    for row in range(MAILBOXES):
        if mailboxes[mailbox + STALE] != 0:
            faults = faults | MAILBOX_FAULTS[row][IF_LOST]
            if mailboxes[mailbox + CORRUPT] != 0:
                faults = faults | MAILBOX_FAULTS[row][IF_CORRUPT]
            if mailboxes[mailbox + INVALID] != 0:
                faults = faults | MAILBOX_FAULTS[row][IF_INVALID]
        if mailboxes[mailbox + OVERRUNS] != 0:
            faults = faults | MAILBOX_OVERRUN
        mailbox = mailbox + MAILBOX_SIZE
    if task[DEFAULT_LAW] == 0:
        faults = faults | CALIBRATION_INVALID
    statusword = mailboxes[STATUSWORD]
    if (statusword & FAULT_BIT) != 0:
        faults = faults | DRIVE_FAULT
    if task[STATE] == SAFE:
        if before == RUN and (statusword & STATE_MASK) != OPERATION_ENABLED:
            faults = faults | DRIVE_NOT_ENABLED
        if task[STILL_PERIODS] >= STUCK_PERIODS:
            faults = faults | POSITION_STUCK
        faults = faults | task[FAULTS]
    return faults


def control(
    mailboxes: Array32, task: Array32, calibration: Array32, state: Array32, io: Array32, has_entered: int32
) -> None:
    """One step of the control law; a reset of it before, where the task `has_entered` the run state."""
    io[IO_SETPOINT] = mailboxes[SETPOINT_POSITION]
    io[IO_POSITION] = mailboxes[FEEDBACK_POSITION]
    if has_entered != 0:
        io[IO_LAW] = mailboxes[COMMAND_LAW]
        if io[IO_LAW] == 0:
            io[IO_LAW] = task[DEFAULT_LAW]
        control_reset(calibration, state, io)
    control_step(calibration, state, io)
    task[VELOCITY] = io[IO_TARGET_VELOCITY]
    if (io[IO_FLAGS] & FLAG_SPEED_LIMITED) != 0 and task[SATURATIONS] < COUNT_MAX:
        task[SATURATIONS] = i32(task[SATURATIONS] + 1)


def controlword_for(statusword: int32, task: Array32, conditions: int32) -> int32:
    """Controlword that answers the drive's statusword."""
    if task[STATE] == SAFE:
        return QUICK_STOP
    if statusword == 0:  # the drive has not been heard of
        return DISABLE_VOLTAGE
    if (statusword & FAULT_MASK) == IN_FAULT:
        if task[RESET_ASKED] != 0:
            return RESET_FAULT
        return DISABLE_VOLTAGE
    if task[STATE] != RUN and (conditions & READY_TO_ENABLE) != READY_TO_ENABLE:
        return SHUTDOWN
    for row in range(len(ENABLING)):
        if (statusword & ENABLING[row][MASK]) == ENABLING[row][VALUE]:
            return ENABLING[row][LEADS_ON]
    return DISABLE_VOLTAGE


def send_command(contract: Array32, task: Array32, frames: Array32) -> None:
    """DriveCommand, the first frame."""
    counter = (task[COMMAND_COUNTER] + 1) & MAX_COUNTER
    begin(frames, 0, contract, DRIVE_COMMAND)
    insert(frames, 0, contract, SENT_CONTROLWORD, task[CONTROLWORD])
    insert(frames, 0, contract, SENT_VELOCITY, task[VELOCITY])
    frames[FRAME_LOW] = profile2_protect(contract, PROTECTION, counter, frames[FRAME_LOW], frames[FRAME_HIGH])
    task[COMMAND_COUNTER] = counter


def send_status(
    contract: Array32, mailboxes: Array32, task: Array32, io: Array32, frames: Array32, frame: int32
) -> None:
    """ControllerStatus."""
    law = io[IO_LAW]
    if law == 0:
        law = task[DEFAULT_LAW]
    overruns = 0
    mailbox = 0
    for _row in range(MAILBOXES):
        overruns = overruns + mailboxes[mailbox + OVERRUNS]
        mailbox = mailbox + MAILBOX_SIZE
    if overruns > COUNT_MAX:
        overruns = COUNT_MAX
    begin(frames, frame, contract, CONTROLLER_STATUS)
    insert(frames, frame, contract, SENT_STATE, task[STATE])
    insert(frames, frame, contract, SENT_LAW, law)
    signal = SENT_FAULTS
    for fault in range(FAULT_COUNT):
        insert(frames, frame, contract, signal, task[FAULTS] >> fault)
        signal = signal + SIGNAL_SIZE
    insert(frames, frame, contract, SENT_EXECUTION_TIME, task[EXECUTION_TIME])
    insert(frames, frame, contract, SENT_SATURATIONS, task[SATURATIONS])
    insert(frames, frame, contract, SENT_OVERRUNS, overruns)


def send_observer(contract: Array32, task: Array32, state: Array32, frames: Array32, frame: int32) -> None:
    """ObserverState: one of its pages after the other."""
    begin(frames, frame, contract, OBSERVER_STATE)
    insert(frames, frame, contract, SENT_PAGE, task[OBSERVER_PAGE])
    insert(frames, frame, contract, SENT_CYCLE, task[CYCLE])
    insert(frames, frame, contract, SENT_VALUE, state[ST_V1 + task[OBSERVER_PAGE]])


def count_period(task: Array32) -> None:
    """Move on to the next period."""
    task[CYCLE] = (task[CYCLE] + 1) & 0xFFFF
    task[STATUS_PHASE] = i32(task[STATUS_PHASE] + 1)
    if task[STATUS_PHASE] == STATUS_PERIODS:
        task[STATUS_PHASE] = 0
    task[OBSERVER_PHASE] = i32(task[OBSERVER_PHASE] + 1)
    if task[OBSERVER_PHASE] == OBSERVER_PERIODS:
        task[OBSERVER_PHASE] = 0
        task[OBSERVER_PAGE] = i32(task[OBSERVER_PAGE] + 1)
        if task[OBSERVER_PAGE] == OBSERVER_PAGES:
            task[OBSERVER_PAGE] = 0


def period(
    contract: Array32,
    mailboxes: Array32,
    task: Array32,
    calibration: Array32,
    state: Array32,
    io: Array32,
    frames: Array32,
) -> int32:
    """Timer interrupt: one control period. The result is how many of `frames` are to be sent."""
    if task[RESTART_ASKED] != 0:
        restart(task, state, io)
    mailbox = 0
    expected = 0
    for _row in range(MAILBOXES):
        poll(mailboxes, mailbox, contract, expected)
        mailbox = mailbox + MAILBOX_SIZE
        expected = expected + EXPECTATION_SIZE
    watch_motion(task, mailboxes[FEEDBACK_POSITION])
    conditions = conditions_of(mailboxes, task)
    before = task[STATE]
    task[STATE] = next_state(before, conditions)
    task[FAULTS] = faults_of(mailboxes, task, before)
    task[VELOCITY] = 0
    if task[STATE] == RUN:
        has_entered = 0
        if before != RUN:
            has_entered = 1
        control(mailboxes, task, calibration, state, io, has_entered)
    task[CONTROLWORD] = controlword_for(mailboxes[STATUSWORD], task, conditions)
    send_command(contract, task, frames)
    frame = FRAME_SIZE
    count = 1
    if task[STATUS_PHASE] == 0:
        send_status(contract, mailboxes, task, io, frames, frame)
        frame = frame + FRAME_SIZE
        count = count + 1
    if task[OBSERVER_PHASE] == OBSERVER_DUE:
        send_observer(contract, task, state, frames, frame)
        count = count + 1
    count_period(task)
    return count
