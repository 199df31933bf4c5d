"""The drive's CiA 402 state machine, supervision and speed command."""

import math

import pytest

from plant_sim import Drive, PlantParameters, State, advance, initial_state
from plant_sim import layout as at

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80
FULL_SPEED = 12000  # 3000 rpm in 0.25 rpm

NOT_READY = State.NOT_READY_TO_SWITCH_ON
DISABLED = State.SWITCH_ON_DISABLED
READY = State.READY_TO_SWITCH_ON
SWITCHED_ON = State.SWITCHED_ON
ENABLED = State.OPERATION_ENABLED
STOPPING = State.QUICK_STOP_ACTIVE
REACTING = State.FAULT_REACTION_ACTIVE
FAULT = State.FAULT


def drive_in(state, target=FULL_SPEED):
    drive = Drive()
    path = {
        NOT_READY: [],
        DISABLED: [None],
        READY: [(SHUTDOWN, 0)],
        SWITCHED_ON: [(SHUTDOWN, 0), (SWITCH_ON, 0)],
        ENABLED: [(SHUTDOWN, 0), (SWITCH_ON, 0), (ENABLE, target)],
    }
    path[STOPPING] = [*path[ENABLED], (QUICK_STOP, 0)]
    path[REACTING] = [*path[ENABLED], None, None, None]
    path[FAULT] = [*path[ENABLED], *[None] * 100]
    for command in path[state]:
        drive.step(command)
    assert drive.state == state
    return drive


@pytest.mark.parametrize(
    ("state", "controlword", "expected"),
    [
        # transition 2 to 7: power
        (DISABLED, SHUTDOWN, READY),
        (DISABLED, SWITCH_ON, DISABLED),
        (DISABLED, ENABLE, DISABLED),
        (DISABLED, DISABLE_VOLTAGE, DISABLED),
        (DISABLED, QUICK_STOP, DISABLED),
        (READY, SHUTDOWN, READY),
        (READY, SWITCH_ON, SWITCHED_ON),
        (READY, ENABLE, SWITCHED_ON),
        (READY, DISABLE_VOLTAGE, DISABLED),
        (READY, QUICK_STOP, DISABLED),
        (SWITCHED_ON, SHUTDOWN, READY),
        (SWITCHED_ON, SWITCH_ON, SWITCHED_ON),
        (SWITCHED_ON, ENABLE, ENABLED),
        (SWITCHED_ON, DISABLE_VOLTAGE, DISABLED),
        (SWITCHED_ON, QUICK_STOP, DISABLED),
        # 5, 8, 9, 11: out of operation
        (ENABLED, SHUTDOWN, READY),
        (ENABLED, SWITCH_ON, SWITCHED_ON),
        (ENABLED, ENABLE, ENABLED),
        (ENABLED, DISABLE_VOLTAGE, DISABLED),
        (ENABLED, QUICK_STOP, STOPPING),
        # 12: a quick stop is not interrupted by anything but disable voltage (option code 2)
        (STOPPING, SHUTDOWN, STOPPING),
        (STOPPING, SWITCH_ON, STOPPING),
        (STOPPING, ENABLE, STOPPING),
        (STOPPING, DISABLE_VOLTAGE, DISABLED),
        (STOPPING, QUICK_STOP, STOPPING),
        # 14: the fault reaction is not interrupted, 15: only a reset leaves the fault
        (REACTING, SHUTDOWN, REACTING),
        (REACTING, DISABLE_VOLTAGE, REACTING),
        (REACTING, ENABLE, REACTING),
        (REACTING, RESET, REACTING),
        (FAULT, SHUTDOWN, FAULT),
        (FAULT, ENABLE, FAULT),
        (FAULT, DISABLE_VOLTAGE, FAULT),
        (FAULT, QUICK_STOP, FAULT),
        (FAULT, RESET, DISABLED),
        # a controlword with bit 7 is a reset and nothing else
        (READY, SWITCH_ON | RESET, READY),
        (ENABLED, SHUTDOWN | RESET, ENABLED),
    ],
)
def test_transition(state, controlword, expected):
    drive = drive_in(state)
    drive.step((controlword, 0))
    assert drive.state == expected


def test_power_up_ends_in_switch_on_disabled_without_any_command():
    drive = Drive()
    assert drive.state == NOT_READY
    drive.step(None)
    assert drive.state == DISABLED


def test_enable_operation_from_ready_passes_switched_on():
    drive = drive_in(READY)
    drive.step((ENABLE, 0))
    assert drive.state == SWITCHED_ON
    drive.step((ENABLE, 0))
    assert drive.state == ENABLED


@pytest.mark.parametrize(
    ("state", "mask", "value"),
    [
        (NOT_READY, 0x4F, 0x00),
        (DISABLED, 0x4F, 0x40),
        (READY, 0x6F, 0x21),
        (SWITCHED_ON, 0x6F, 0x23),
        (ENABLED, 0x6F, 0x27),
        (STOPPING, 0x6F, 0x07),
        (REACTING, 0x4F, 0x0F),
        (FAULT, 0x4F, 0x08),
    ],
)
def test_statusword_shows_the_state_as_cia_402_codes_it(state, mask, value):
    word = drive_in(state).statusword
    assert word & mask == value
    assert word & 0x0010, "voltage enabled"
    assert word & 0x0200, "remote"


def test_statusword_tells_that_the_drive_follows_the_command_only_in_operation():
    follows = {state for state in State if drive_in(state).statusword & 0x1000}
    assert follows == {ENABLED}


def test_target_is_in_quarter_rpm():
    drive = drive_in(ENABLED)
    assert drive.step((ENABLE, 400)) == pytest.approx(100.0 * math.pi / 30.0)
    assert drive.step((ENABLE, -1)) == pytest.approx(-0.25 * math.pi / 30.0)


@pytest.mark.parametrize("state", [state for state in State if state not in (ENABLED, STOPPING, REACTING)])
def test_speed_is_zero_unless_enabled_or_ramping(state):
    assert drive_in(state).step((SHUTDOWN, FULL_SPEED)) == 0.0


@pytest.mark.parametrize("controlword", [SHUTDOWN, SWITCH_ON, DISABLE_VOLTAGE])
def test_leaving_operation_sets_the_command_to_zero_at_once(controlword):
    assert drive_in(ENABLED).step((controlword, FULL_SPEED)) == 0.0


@pytest.mark.parametrize(("target", "limit_rpm"), [(12001, 3000.0), (-32768, -3000.0)])
def test_targets_beyond_the_top_speed_are_limited_and_reported(target, limit_rpm):
    drive = drive_in(ENABLED)
    assert drive.step((ENABLE, target)) == pytest.approx(limit_rpm * math.pi / 30.0)
    assert drive.statusword & 0x0800
    drive.step((ENABLE, 12000))
    assert not drive.statusword & 0x0800


def periods_to_stop(drive, command):
    previous, periods = math.inf, 0
    while drive.state in (STOPPING, REACTING):
        speed = abs(drive.step(command))
        assert speed < previous
        previous = speed
        periods += 1
    assert previous == 0.0
    return periods


@pytest.mark.parametrize("target", [FULL_SPEED, -FULL_SPEED])
def test_quick_stop_takes_79_ms_from_full_speed_then_disables(target):
    drive = drive_in(ENABLED, target)
    first = drive.step((QUICK_STOP, target))
    assert abs(first) < 100.0 * math.pi
    assert math.copysign(1.0, first) == math.copysign(1.0, target)
    assert 1 + periods_to_stop(drive, (QUICK_STOP, target)) == 79
    assert drive.state == DISABLED


@pytest.mark.parametrize(("deceleration_rad_s2", "periods"), [(1.0, 6), (27.0, 6), (53.0, 3), (53.0e3, 1)])
def test_a_stop_loses_whole_counts_each_period_and_at_least_one(deceleration_rad_s2, periods):
    drive = Drive(deceleration_rad_s2=deceleration_rad_s2)
    for command in [(SHUTDOWN, 0), (SWITCH_ON, 0), (ENABLE, 0), (ENABLE, 6)]:
        drive.step(command)
    steps = 0
    while drive.state != DISABLED:
        drive.step((QUICK_STOP, 6))
        steps += 1
    assert steps == periods


def test_two_missed_commands_hold_the_last_target():
    drive = drive_in(ENABLED)
    assert [drive.step(None) for _ in range(2)] == pytest.approx([100.0 * math.pi] * 2)
    assert drive.state == ENABLED


def test_a_valid_command_starts_the_count_of_missed_ones_again():
    drive = drive_in(ENABLED)
    for _ in range(10):
        drive.step(None)
        drive.step(None)
        drive.step((ENABLE, FULL_SPEED))
    assert drive.state == ENABLED


def test_the_third_missed_command_stops_within_79_ms_and_faults():
    drive = drive_in(ENABLED)
    for _ in range(2):
        drive.step(None)
    assert not drive.statusword & 0x0008
    drive.step(None)
    assert drive.state == REACTING
    assert drive.statusword & 0x0008
    assert 1 + periods_to_stop(drive, None) == 79
    assert drive.state == FAULT


def test_a_standing_drive_that_loses_its_command_faults_at_once():
    drive = drive_in(ENABLED, 0)
    for _ in range(3):
        drive.step(None)
    assert drive.state == FAULT


def test_the_motor_itself_stops_within_95_ms_of_the_third_missed_command():
    """The command is zero after 79 ms; the motor follows it with its lag of 5 ms."""
    parameters = PlantParameters()
    p, state = parameters.vector(), initial_state(parameters, 0.1)
    state[at.MOTOR_SPEED] = 100.0 * math.pi
    drive = drive_in(ENABLED)
    for _ in range(2):
        drive.step(None)
    for _ in range(95):
        advance(state, p, drive.step(None), 0.0, 1e-3, 10)
    assert abs(state[at.MOTOR_SPEED]) < 1.0


@pytest.mark.parametrize("state", [NOT_READY, DISABLED, READY, SWITCHED_ON])
def test_supervision_never_trips_a_drive_that_is_not_enabled(state):
    drive = drive_in(state)
    for _ in range(1000):
        drive.step(None)
    assert drive.state == (DISABLED if state == NOT_READY else state)


def test_losing_commands_during_a_quick_stop_does_not_disturb_it():
    drive = drive_in(STOPPING)
    periods_to_stop(drive, None)
    assert drive.state == DISABLED


def test_a_fault_stays_until_a_rising_reset_edge():
    drive = drive_in(FAULT)
    for _ in range(100):
        drive.step((ENABLE, FULL_SPEED))
    assert drive.state == FAULT
    drive.step((RESET, 0))
    assert drive.state == DISABLED


def test_a_reset_bit_that_was_set_all_along_does_not_reset():
    drive = drive_in(ENABLED)
    drive.step((ENABLE | RESET, FULL_SPEED))
    for _ in range(100):
        drive.step(None)
    drive.step((ENABLE | RESET, 0))
    assert drive.state == FAULT
    drive.step((ENABLE, 0))
    drive.step((ENABLE | RESET, 0))
    assert drive.state == DISABLED


def test_after_a_reset_the_drive_can_be_enabled_again():
    drive = drive_in(FAULT)
    for controlword in (RESET, SHUTDOWN, SWITCH_ON, ENABLE):
        speed = drive.step((controlword, 400))
    assert drive.state == ENABLED
    assert speed == pytest.approx(100.0 * math.pi / 30.0)


# commands that wait


def history(delay_periods, commands):
    drive = Drive(delay_periods=delay_periods)
    return [(drive.step(command), drive.state, drive.statusword) for command in commands]


@pytest.mark.parametrize("delay_periods", [2, 3])
def test_a_drive_with_more_delay_does_the_same_one_or_two_cycles_later(delay_periods):
    """Power-up, motion, lost commands up to the fault, and a reset: all of it."""
    moving = [(ENABLE, 400 * k) for k in range(1, 10)]
    commands = [(SHUTDOWN, 0), (SWITCH_ON, 0), *moving, None, (ENABLE, -600), *[None] * 9, (RESET, 0), None]
    later = delay_periods - 1
    prompt = history(1, [*[None] * later, *commands])
    assert history(delay_periods, [*commands, *[None] * later]) == prompt
    assert {state for _, state, _ in prompt} >= {ENABLED, REACTING, FAULT}


@pytest.mark.parametrize("delay_periods", [0, 4])
def test_other_delays_are_refused(delay_periods):
    with pytest.raises(ValueError, match=f"delay_periods is {delay_periods}, must be from 1 to 3"):
        Drive(delay_periods=delay_periods)
