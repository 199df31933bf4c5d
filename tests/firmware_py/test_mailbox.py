"""Receive mailboxes: the newest valid frame, why one was refused, and how long none came."""

from typing import Any

import pytest

from dbc import profile2
from dbc.codec import MessageCodec
from dbc.contract import Contract
from dbc.frame import Frame
from firmware_py import checked
from firmware_py import task_layout as at
from firmware_py.contract_words import expectation

FIRMWARE = checked.load()
CONTRACT = Contract.load()
FEEDBACK = CONTRACT.position_feedback
COMMAND = CONTRACT.controller_command
SENSOR_OK, SENSOR_BROKEN = 0, 3
BEGIN = 50
OTHERS = [99] * BEGIN
"""What lies around the mailbox, and around what is expected of it."""


class Mailbox:
    """One of the controller's mailboxes, on checked integers."""

    def __init__(self, message: MessageCodec[..., Any] = FEEDBACK, **plausible: tuple[int, int]) -> None:
        self._expected = checked.CheckedArray([*OTHERS, *expectation(message, plausible), *OTHERS])
        self._words = checked.CheckedArray([99] * (len(OTHERS) + at.MAILBOX_SIZE + len(OTHERS)))
        self._functions = FIRMWARE["mailbox"]
        self._functions.clear(self._words, BEGIN, self._expected, BEGIN)

    def period(self, *frames: Frame | None) -> None:
        """Receive frames, then poll."""
        for frame in frames:
            if frame is not None:
                low, high = map(checked.low32, map(checked.i64, (frame.data, frame.data >> 32)))
                self._functions.take(self._words, BEGIN, frame.dlc, low, high)
        self._functions.poll(self._words, BEGIN, self._expected, BEGIN)
        assert self._words[:BEGIN] == self._words[-BEGIN:] == OTHERS

    def word(self, index: int) -> int:
        return int(self._words[BEGIN + index])

    @property
    def position(self) -> int:
        return self.word(at.VALUES + 1)

    @property
    def is_new(self) -> bool:
        return bool(self.word(at.IS_NEW))

    @property
    def stale(self) -> bool:
        return bool(self.word(at.STALE))

    @property
    def corrupt(self) -> bool:
        return bool(self.word(at.CORRUPT))

    @property
    def invalid(self) -> bool:
        return bool(self.word(at.INVALID))

    @property
    def overruns(self) -> int:
        return self.word(at.OVERRUNS)


class Sender:
    """Sends PositionFeedback; each frame has the next counter and a position one higher."""

    def __init__(self) -> None:
        self._protector = FEEDBACK.protector()
        self._position = 0
        self.last = Frame(0, 0, 0)

    def good(self, status: int = SENSOR_OK) -> Frame:
        self._position += 1
        self.last = FEEDBACK.frame(self._protector.protect(FEEDBACK.pack(status, self._position)))
        return self.last

    def missing(self) -> None:
        self.good()

    def wrong_crc(self) -> Frame:
        frame = self.good()
        return frame._replace(data=frame.data ^ 1 << 20)

    def repeated(self) -> Frame:
        return self.last

    def too_short(self) -> Frame:
        return self.good()._replace(dlc=5)

    def too_long(self) -> Frame:
        return self.good()._replace(dlc=8)

    def implausible(self) -> Frame:
        return self.good(SENSOR_BROKEN)

    def out_of_sequence(self) -> Frame:
        for _ in range(6):
            self.good()
        return self.last


BAD = ("missing", "wrong_crc", "repeated", "too_short", "too_long", "implausible")


@pytest.fixture
def sender() -> Sender:
    return Sender()


@pytest.fixture
def mailbox(sender: Sender) -> Mailbox:
    """A mailbox that has just received a valid frame, position 2."""
    mailbox = Mailbox(sensor_status=(SENSOR_OK, SENSOR_OK), position=(0, 1000))
    for _ in range(2):
        mailbox.period(sender.good())
    assert not mailbox.stale
    return mailbox


def test_it_is_stale_until_the_first_valid_frame():
    mailbox = Mailbox()
    assert mailbox.stale
    for _ in range(10):
        mailbox.period()
        assert (mailbox.stale, mailbox.is_new) == (True, False)


def test_the_very_first_frame_only_tells_where_the_counter_stands(sender):
    mailbox = Mailbox()
    mailbox.period(sender.good())
    assert (mailbox.stale, mailbox.is_new, mailbox.corrupt) == (True, False, False)
    mailbox.period(sender.good())
    assert (mailbox.stale, mailbox.position, mailbox.is_new) == (False, 2, True)


def test_between_frames_the_value_stays_but_is_not_new(mailbox):
    mailbox.period(None)
    assert (mailbox.position, mailbox.is_new) == (2, False)


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_frame_does_not_touch_the_value(mailbox, sender, bad):
    mailbox.period(getattr(sender, bad)())
    assert (mailbox.position, mailbox.is_new) == (2, False)


@pytest.mark.parametrize("bad", BAD)
def test_two_bad_periods_are_forgiven(mailbox, sender, bad):
    for _ in range(2):
        mailbox.period(getattr(sender, bad)())
        assert not mailbox.stale
    mailbox.period(sender.good())
    assert (mailbox.is_new, mailbox.stale, mailbox.corrupt, mailbox.invalid) == (True, False, False, False)


@pytest.mark.parametrize("bad", [*BAD, "out_of_sequence"])
def test_the_third_bad_period_makes_it_stale(mailbox, sender, bad):
    for expected in (False, False, True, True):
        mailbox.period(getattr(sender, bad)())
        assert mailbox.stale is expected


def test_any_three_bad_periods_make_it_stale(mailbox, sender):
    for bad in ("missing", "wrong_crc", "implausible"):
        mailbox.period(getattr(sender, bad)())
    assert mailbox.stale


def test_a_jump_of_the_counter_costs_one_frame(mailbox, sender):
    mailbox.period(sender.out_of_sequence())
    assert (mailbox.is_new, mailbox.corrupt) == (False, True)
    mailbox.period(sender.good())
    assert (mailbox.is_new, mailbox.corrupt) == (True, False)


def test_one_lost_frame_costs_nothing_more(mailbox, sender):
    sender.good()
    mailbox.period(sender.good())
    assert mailbox.is_new


def test_valid_frames_end_staleness(mailbox, sender):
    for _ in range(50):
        mailbox.period(None)
    for _ in range(2):  # the first one only synchronises the counter again
        mailbox.period(sender.good())
    assert not mailbox.stale


@pytest.mark.parametrize(
    ("bad", "corrupt", "invalid"),
    [
        ("missing", False, False),
        ("wrong_crc", True, False),
        ("repeated", True, False),
        ("too_short", True, False),
        ("out_of_sequence", True, False),
        ("implausible", False, True),
    ],
)
def test_it_says_why(mailbox, sender, bad, corrupt, invalid):
    mailbox.period(getattr(sender, bad)())
    assert (mailbox.corrupt, mailbox.invalid) == (corrupt, invalid)


def test_the_newest_frame_counts_and_overwritten_ones_are_counted(mailbox, sender):
    mailbox.period(sender.good(), sender.good(), sender.good())
    assert mailbox.overruns == 2
    mailbox.period(sender.good())
    assert (mailbox.overruns, mailbox.position) == (2, 6)


def test_signed_signals_and_the_ends_of_the_plausible_range(sender):
    mailbox, protect = Mailbox(position=(-500, 1000)), FEEDBACK.protector().protect
    expected = [(-501, False), (-500, True), (1000, True), (1001, False), (-1, True), (-(2**31), False)]
    mailbox.period(FEEDBACK.frame(protect(FEEDBACK.pack(0, 0))))
    for position, plausible in expected:
        mailbox.period(FEEDBACK.frame(protect(FEEDBACK.pack(0, position))))
        assert (mailbox.is_new, mailbox.invalid) == (plausible, not plausible)
        if plausible:
            assert mailbox.position == position


def test_a_message_of_100_ms_is_stale_after_300():
    mailbox, protector = Mailbox(COMMAND), COMMAND.protector()
    for number in range(301):
        due = number % 100 == 0
        mailbox.period(COMMAND.frame(protector.protect(COMMAND.pack(1, 3, 0))) if due else None)
    for _ in range(299):
        mailbox.period(None)
        assert not mailbox.stale
    mailbox.period(None)
    assert mailbox.stale


def test_age_and_overruns_stop_where_they_no_longer_matter(sender):
    mailbox = Mailbox()
    for _ in range(20):
        mailbox.period(None)
    assert mailbox.word(at.AGE) == 3
    mailbox._words[BEGIN + at.OVERRUNS] = at.COUNT_MAX - 1
    mailbox.period(*[sender.good() for _ in range(4)])
    assert mailbox.overruns == at.COUNT_MAX


def test_an_unsigned_signal_is_unsigned_whatever_its_plausible_range(sender):
    mailbox = Mailbox(sensor_status=(1, 15))
    for _ in range(2):
        mailbox.period(sender.good(12))
    assert (mailbox.is_new, mailbox.word(at.VALUES)) == (True, 12)


@pytest.mark.parametrize("late", [1, 50, 99])
def test_a_slow_message_is_missed_once_in_each_cycle_since_it_was_valid(late):
    mailbox, protector = Mailbox(COMMAND), COMMAND.protector()

    def missed() -> int:
        return mailbox.word(profile2.NO_NEW_OR_REPEATED_DATA_COUNTER)

    def frame() -> Frame:
        return COMMAND.frame(protector.protect(COMMAND.pack(1, 3, 0)))

    mailbox.period(frame())
    for _ in range(late):
        mailbox.period(None)
    mailbox.period(frame())
    assert (mailbox.is_new, missed()) == (True, 0)
    for period in range(1, 450):
        mailbox.period(None)
        assert missed() == period // 100


def test_receiving_between_polls_counts_as_one_check(sender):
    mailbox = Mailbox()
    mailbox.period(sender.good())
    mailbox.period(sender.missing())
    assert mailbox.word(profile2.NO_NEW_OR_REPEATED_DATA_COUNTER) == 1
    assert mailbox.word(at.ARRIVED) == 0
