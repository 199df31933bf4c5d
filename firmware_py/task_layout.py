"""Named indices of the control task's int32 arrays `block`, `contract`, `mailboxes`, `task` and `frames`.

`block` is the calibration as flashed; the bytes of a word lie low byte first. `contract` says what the DBC
file says: what is expected of each message received, then where the signals of the others lie. A signal lies
at two words: its start bit and its length.
"""

from dbc.profile2 import CONFIGURATION_SIZE, STATE_SIZE
from firmware_py.kernel.layout import CAL_SIZE

MAX_FIELDS = 3
STALE_CYCLES = 3  # cycles of a message without valid data after which it counts as lost

# block
BLOCK_MAGIC = 0
BLOCK_VERSION = 1  # layout version in the low half, default control law in the high one
BLOCK_COUNT = 2  # number of the calibration's words in the low half
BLOCK_WORDS = 3  # where they begin
BLOCK_CRC = BLOCK_WORDS + CAL_SIZE  # CRC-32 of all before it
BLOCK_SIZE = BLOCK_CRC + 1

# mailboxes
MAILBOXES = 4

# a mailbox: the receiver's E2E state, then
ARRIVED = STATE_SIZE + 0  # whether a frame has arrived since the last poll
LOW = STATE_SIZE + 1  # payload of the newest, bytes 0 to 3
HIGH = STATE_SIZE + 2  # bytes 4 to 7
LENGTH = STATE_SIZE + 3  # its number of bytes
IS_NEW = STATE_SIZE + 4  # whether the last poll brought a valid frame
AGE = STATE_SIZE + 5  # periods since the last valid frame, up to the limit
PHASE = STATE_SIZE + 6  # periods since the last valid frame or whole cycle
STALE = STATE_SIZE + 7  # whether AGE has reached the limit
CORRUPT = STATE_SIZE + 8  # whether the last frame failed its E2E check
INVALID = STATE_SIZE + 9  # whether the last intact frame was not plausible
OVERRUNS = STATE_SIZE + 10  # frames overwritten before they were read, up to COUNT_MAX
CANDIDATES = STATE_SIZE + 11  # signals of the newest intact frame
VALUES = CANDIDATES + MAX_FIELDS  # signals of the newest valid frame
MAILBOX_SIZE = VALUES + MAX_FIELDS
COUNT_MAX = 0xFFFF

# where they begin
FEEDBACK = 0
SETPOINT = MAILBOX_SIZE
COMMAND = SETPOINT + MAILBOX_SIZE
DRIVE_STATUS = COMMAND + MAILBOX_SIZE
MAILBOXES_SIZE = DRIVE_STATUS + MAILBOX_SIZE

# their signals
FEEDBACK_POSITION = FEEDBACK + VALUES + 1
SETPOINT_POSITION = SETPOINT + VALUES
COMMAND_ENABLE = COMMAND + VALUES
COMMAND_LAW = COMMAND + VALUES + 1
COMMAND_FAULT_RESET = COMMAND + VALUES + 2
STATUSWORD = DRIVE_STATUS + VALUES

# contract: of each mailbox what is expected, the receiver's E2E configuration first, then
EXPECTED_ID = CONFIGURATION_SIZE + 0  # identifier, bit 31 set for one of 29 bits
CYCLE_PERIODS = CONFIGURATION_SIZE + 1
STALE_PERIODS = CONFIGURATION_SIZE + 2  # limit of AGE
FIELD_COUNT = CONFIGURATION_SIZE + 3
FIELDS = CONFIGURATION_SIZE + 4  # of each: start, length, whether signed, lowest and highest plausible value
FIELD_SIZE = 5
EXPECTATION_SIZE = FIELDS + MAX_FIELDS * FIELD_SIZE
PROTECTION = MAILBOXES * EXPECTATION_SIZE  # DriveCommand's E2E configuration

# contract: the other messages; of each identifier and length, then its signals
MESSAGE_ID = 0
MESSAGE_LENGTH = 1
MESSAGE_SIGNALS = 2
SIGNAL_SIZE = 2
FAULT_COUNT = 15

DRIVE_COMMAND = PROTECTION + CONFIGURATION_SIZE
SENT_CONTROLWORD = DRIVE_COMMAND + MESSAGE_SIGNALS
SENT_VELOCITY = SENT_CONTROLWORD + SIGNAL_SIZE

CONTROLLER_STATUS = SENT_VELOCITY + SIGNAL_SIZE
SENT_STATE = CONTROLLER_STATUS + MESSAGE_SIGNALS
SENT_LAW = SENT_STATE + SIGNAL_SIZE
SENT_FAULTS = SENT_LAW + SIGNAL_SIZE
SENT_EXECUTION_TIME = SENT_FAULTS + FAULT_COUNT * SIGNAL_SIZE
SENT_SATURATIONS = SENT_EXECUTION_TIME + SIGNAL_SIZE
SENT_OVERRUNS = SENT_SATURATIONS + SIGNAL_SIZE

OBSERVER_STATE = SENT_OVERRUNS + SIGNAL_SIZE
SENT_PAGE = OBSERVER_STATE + MESSAGE_SIGNALS
SENT_CYCLE = SENT_PAGE + SIGNAL_SIZE
SENT_VALUE = SENT_CYCLE + SIGNAL_SIZE

BENCH_CONTROL = SENT_VALUE + SIGNAL_SIZE
BENCH_COMMAND = BENCH_CONTROL + MESSAGE_SIGNALS
CONTRACT_SIZE = BENCH_COMMAND + SIGNAL_SIZE

# task
STATE = 0
FAULTS = 1  # what is wrong now and any overrun since power-on; in the safe state what led there
DEFAULT_LAW = 2  # the calibration's control law, 0 without a valid calibration
ARMED = 3  # whether a command without Enable came since power-on or the last fault
RESET_ASKED = 4  # FaultReset of the last period
SATURATIONS = 5  # periods in which the drive's speed limited the command, up to COUNT_MAX
COMMAND_COUNTER = 6  # E2E counter of DriveCommand
CONTROLWORD = 7  # out: CiA 402 controlword
VELOCITY = 8  # out: target velocity, 0.25 rpm
EXECUTION_TIME = 9  # share of the control period, 0.5 %: assumed, unless whoever measures it writes it here
RESTART_ASKED = 10  # whether the bench asked for a reset
CYCLE = 11  # control periods, low 16 bits
STATUS_PHASE = 12  # periods since ControllerStatus
OBSERVER_PHASE = 13  # periods modulo those of ObserverState
OBSERVER_PAGE = 14
STILL_POSITION = 15  # where the position was when it last moved or the motor was slow, um
STILL_PERIODS = 16  # periods since then
TASK_SIZE = 17

# fault bits, in the order of ControllerStatus
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
POSITION_STUCK = 1 << 14

# a frame to send
FRAME_ID = 0
FRAME_LENGTH = 1
FRAME_LOW = 2
FRAME_HIGH = 3
FRAME_SIZE = 4
MAX_FRAMES = 3
FRAMES_SIZE = MAX_FRAMES * FRAME_SIZE
