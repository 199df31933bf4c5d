"""The control task's arrays: each word has its place, no two the same, and the contract's words lie there."""

import pytest

from dbc.contract import Contract
from dbc.profile2 import CONFIGURATION_SIZE, STATE_SIZE
from firmware_py import task_layout as at
from firmware_py.contract_words import contract_words

CONTRACT = Contract.load()
WORDS = contract_words(CONTRACT).tolist()
RECEIVED = (
    CONTRACT.position_feedback,
    CONTRACT.position_setpoint,
    CONTRACT.controller_command,
    CONTRACT.drive_status,
)


@pytest.mark.parametrize(
    ("names", "first"),
    [
        ("BLOCK_MAGIC BLOCK_VERSION BLOCK_COUNT BLOCK_WORDS", 0),
        ("ARRIVED LOW HIGH LENGTH IS_NEW AGE PHASE STALE CORRUPT INVALID OVERRUNS CANDIDATES", STATE_SIZE),
        ("EXPECTED_ID CYCLE_PERIODS STALE_PERIODS FIELD_COUNT FIELDS", CONFIGURATION_SIZE),
        ("MESSAGE_ID MESSAGE_LENGTH MESSAGE_SIGNALS", 0),
        (
            "STATE FAULTS DEFAULT_LAW ARMED RESET_ASKED SATURATIONS COMMAND_COUNTER CONTROLWORD VELOCITY"
            " EXECUTION_TIME RESTART_ASKED CYCLE STATUS_PHASE OBSERVER_PHASE OBSERVER_PAGE STILL_POSITION"
            " STILL_PERIODS TASK_SIZE",
            0,
        ),
        ("FRAME_ID FRAME_LENGTH FRAME_LOW FRAME_HIGH FRAME_SIZE", 0),
    ],
)
def test_words_follow_each_other(names, first):
    places = [getattr(at, name) for name in names.split()]
    assert places == list(range(first, first + len(places)))


def test_mailboxes_follow_each_other_in_the_order_of_the_contract():
    assert max(len(message.fields) for message in RECEIVED) == at.MAX_FIELDS
    assert (at.VALUES, at.MAILBOX_SIZE) == (at.CANDIDATES + at.MAX_FIELDS, at.CANDIDATES + 2 * at.MAX_FIELDS)
    blocks = [at.FEEDBACK, at.SETPOINT, at.COMMAND, at.DRIVE_STATUS, at.MAILBOXES_SIZE]
    assert blocks == [number * at.MAILBOX_SIZE for number in range(at.MAILBOXES + 1)]
    places = {
        (at.FEEDBACK_POSITION, 0, "position"),
        (at.SETPOINT_POSITION, 1, "position"),
        (at.COMMAND_ENABLE, 2, "enable"),
        (at.COMMAND_LAW, 2, "control_law"),
        (at.COMMAND_FAULT_RESET, 2, "fault_reset"),
        (at.STATUSWORD, 3, "statusword"),
    }
    for place, number, name in places:
        fields = [field.name for field in RECEIVED[number].fields]
        assert place == blocks[number] + at.VALUES + fields.index(name), name


def test_what_is_expected_of_each_message_lies_where_it_is_looked_for():
    assert at.EXPECTATION_SIZE == at.FIELDS + at.FIELD_SIZE * at.MAX_FIELDS
    assert at.PROTECTION == at.MAILBOXES * at.EXPECTATION_SIZE
    for number, message in enumerate(RECEIVED):
        row = WORDS[number * at.EXPECTATION_SIZE :][: at.EXPECTATION_SIZE]
        assert row[:CONFIGURATION_SIZE] == message.receiver_configuration().tolist()
        assert row[at.EXPECTED_ID] == message.can_id
        assert row[at.STALE_PERIODS] == at.STALE_CYCLES * row[at.CYCLE_PERIODS]
        for place, field in zip(range(at.FIELDS, 999, at.FIELD_SIZE), message.fields, strict=False):
            assert row[place : place + 3] == [field.start, field.length, field.signed]
    sender = CONTRACT.drive_command.receiver_configuration().tolist()
    assert WORDS[at.PROTECTION :][:CONFIGURATION_SIZE] == sender


@pytest.mark.parametrize(
    ("message", "begin", "signals"),
    [
        (
            CONTRACT.drive_command,
            at.DRIVE_COMMAND,
            {"controlword": at.SENT_CONTROLWORD, "target_velocity": at.SENT_VELOCITY},
        ),
        (
            CONTRACT.controller_status,
            at.CONTROLLER_STATUS,
            {
                "state": at.SENT_STATE,
                "control_law": at.SENT_LAW,
                "feedback_lost": at.SENT_FAULTS,
                "position_stuck": at.SENT_FAULTS + (at.FAULT_COUNT - 1) * at.SIGNAL_SIZE,
                "execution_time": at.SENT_EXECUTION_TIME,
                "saturations": at.SENT_SATURATIONS,
                "mailbox_overruns": at.SENT_OVERRUNS,
            },
        ),
        (
            CONTRACT.observer_state,
            at.OBSERVER_STATE,
            {"page": at.SENT_PAGE, "cycle": at.SENT_CYCLE, "value": at.SENT_VALUE},
        ),
        (CONTRACT.bench_control, at.BENCH_CONTROL, {"command": at.BENCH_COMMAND}),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_signals_of_the_other_messages_lie_where_they_are_looked_for(message, begin, signals):
    head = WORDS[begin + at.MESSAGE_ID] & 0xFFFF_FFFF, WORDS[begin + at.MESSAGE_LENGTH]
    assert head == (message.can_id, message.dlc)
    fields = {field.name: [field.start, field.length] for field in message.fields}
    for name, place in signals.items():
        assert WORDS[place : place + at.SIGNAL_SIZE] == fields[name], name


def test_the_arrays_end_where_their_last_words_do():
    assert len(WORDS) == at.CONTRACT_SIZE == at.BENCH_COMMAND + at.SIGNAL_SIZE
    assert (at.SIGNAL_SIZE, at.FIELD_SIZE) == (2, 5)
    assert at.FRAMES_SIZE == at.MAX_FRAMES * at.FRAME_SIZE == 3 * 4
    overruns = next(f for f in CONTRACT.controller_status.fields if f.name == "mailbox_overruns")
    assert overruns.mask == at.COUNT_MAX


def test_fault_bits_are_in_the_order_of_the_status():
    names = [name.upper() for name in (field.name for field in CONTRACT.controller_status.fields)]
    bits = [getattr(at, name) for name in names if hasattr(at, name) and name not in ("STATE", "SATURATIONS")]
    assert bits[: at.FAULT_COUNT] == [1 << bit for bit in range(at.FAULT_COUNT)]
