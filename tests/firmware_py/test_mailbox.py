"""Receive mailboxes: the newest valid frame, why one was refused, and how long none came."""

import pytest

from dbc.contract import Contract
from dbc.frame import Frame
from firmware_py.mailbox import Mailbox

CONTRACT = Contract.load()
FEEDBACK = CONTRACT.position_feedback
COMMAND = CONTRACT.controller_command
SENSOR_OK, SENSOR_BROKEN = 0, 3


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
    mailbox = Mailbox(FEEDBACK, lambda value: value.sensor_status == SENSOR_OK)
    for _ in range(2):
        period(mailbox, sender.good())
    assert not mailbox.stale
    return mailbox


def period(mailbox: Mailbox, frame: Frame | None) -> None:
    if frame is not None:
        mailbox.receive(frame)
    mailbox.poll()


def test_it_is_stale_until_the_first_valid_frame():
    mailbox = Mailbox(FEEDBACK)
    assert (mailbox.stale, mailbox.value) == (True, None)
    mailbox.poll()
    assert (mailbox.stale, mailbox.value) == (True, None)


def test_the_very_first_frame_only_tells_where_the_counter_stands(sender):
    mailbox = Mailbox(FEEDBACK)
    period(mailbox, sender.good())
    assert (mailbox.stale, mailbox.value, mailbox.corrupt) == (True, None, False)
    period(mailbox, sender.good())
    assert (mailbox.stale, mailbox.value.position, mailbox.is_new) == (False, 2, True)


def test_between_frames_the_value_stays_but_is_not_new(mailbox):
    period(mailbox, None)
    assert (mailbox.value.position, mailbox.is_new) == (2, False)


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_frame_does_not_touch_the_value(mailbox, sender, bad):
    period(mailbox, getattr(sender, bad)())
    assert (mailbox.value.position, mailbox.is_new) == (2, False)


@pytest.mark.parametrize("bad", BAD)
def test_two_bad_periods_are_forgiven(mailbox, sender, bad):
    for _ in range(2):
        period(mailbox, getattr(sender, bad)())
        assert not mailbox.stale
    period(mailbox, sender.good())
    assert (mailbox.is_new, mailbox.stale, mailbox.corrupt, mailbox.invalid) == (True, False, False, False)


@pytest.mark.parametrize("bad", [*BAD, "out_of_sequence"])
def test_the_third_bad_period_makes_it_stale(mailbox, sender, bad):
    for expected in (False, False, True, True):
        period(mailbox, getattr(sender, bad)())
        assert mailbox.stale is expected


def test_any_three_bad_periods_make_it_stale(mailbox, sender):
    for bad in ("missing", "wrong_crc", "implausible"):
        period(mailbox, getattr(sender, bad)())
    assert mailbox.stale


def test_a_jump_of_the_counter_costs_one_frame(mailbox, sender):
    period(mailbox, sender.out_of_sequence())
    assert (mailbox.is_new, mailbox.corrupt) == (False, True)
    period(mailbox, sender.good())
    assert (mailbox.is_new, mailbox.corrupt) == (True, False)


def test_one_lost_frame_costs_nothing_more(mailbox, sender):
    sender.good()
    period(mailbox, sender.good())
    assert mailbox.is_new


def test_valid_frames_end_staleness(mailbox, sender):
    for _ in range(50):
        period(mailbox, None)
    for _ in range(2):  # the first one only synchronises the counter again
        period(mailbox, sender.good())
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
    period(mailbox, getattr(sender, bad)())
    assert (mailbox.corrupt, mailbox.invalid) == (corrupt, invalid)


def test_the_newest_frame_counts_and_overwritten_ones_are_counted(mailbox, sender):
    for _ in range(3):
        mailbox.receive(sender.good())
    mailbox.poll()
    assert mailbox.overruns == 2
    period(mailbox, sender.good())
    assert (mailbox.overruns, mailbox.value.position) == (2, 6)


def test_a_message_of_100_ms_is_stale_after_300():
    mailbox, protector = Mailbox(COMMAND), COMMAND.protector()
    for number in range(301):
        due = number % 100 == 0
        period(mailbox, COMMAND.frame(protector.protect(COMMAND.pack(1, 3, 0))) if due else None)
    for _ in range(299):
        period(mailbox, None)
        assert not mailbox.stale
    period(mailbox, None)
    assert mailbox.stale
