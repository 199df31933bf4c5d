"""Receive mailboxes: the newest frame of each id, its E2E check, and how long it has been missing."""

from collections.abc import Callable
from typing import Any

from dbc.codec import MessageCodec
from dbc.e2e import ACCEPTED, Status
from dbc.frame import Frame
from dbc.node import PERIOD_NS

STALE_CYCLES = 3
"""Cycles of a message without valid data after which it counts as lost."""


class Mailbox:
    """One protected message, checked once per control period.

    Parameters
    ----------
    message : MessageCodec
        The message received; its cycle time sets the staleness limit.
    plausible : callable
        Tells whether the signals of an intact frame may be used.

    Attributes
    ----------
    value : NamedTuple or None
        Signals (raw) of the newest valid frame.
    is_new : bool
        Whether this period brought a valid frame.
    corrupt : bool
        Whether the last frame that came failed its E2E check.
    invalid : bool
        Whether the last intact frame was not plausible.
    overruns : int
        Frames overwritten before they were read.
    stale : bool
        Whether valid data have been missing for `STALE_CYCLES`.
    """

    __slots__ = (
        "_age_periods",
        "_check",
        "_cycle_periods",
        "_dlc",
        "_frame",
        "_plausible",
        "_stale_periods",
        "_unpack",
        "corrupt",
        "invalid",
        "is_new",
        "overruns",
        "stale",
        "value",
    )

    def __init__(
        self, message: MessageCodec[..., Any], plausible: Callable[[Any], bool] = lambda value: True
    ) -> None:
        self._unpack = message.unpack
        self._dlc = message.dlc
        self._check = message.checker().check
        self._cycle_periods = max(message.cycle_time_ns // PERIOD_NS, 1)
        self._stale_periods = STALE_CYCLES * self._cycle_periods
        self._age_periods = self._stale_periods
        self._frame: Frame | None = None
        self._plausible = plausible
        self.value: Any = None
        self.is_new = False
        self.corrupt = False
        self.invalid = False
        self.overruns = 0
        self.stale = True

    def receive(self, frame: Frame) -> None:
        """Store a frame (receive interrupt)."""
        if self._frame is not None:
            self.overruns += 1
        self._frame = frame

    def poll(self) -> None:
        """Check what arrived since the last period."""
        frame, self._frame = self._frame, None
        self.is_new = False
        self._age_periods += 1
        self.stale = self._age_periods >= self._stale_periods
        if frame is None:
            if self._age_periods % self._cycle_periods == 0:
                self._check(None)
            return
        status = self._check(frame.data if frame.dlc == self._dlc else None)
        if status not in ACCEPTED:
            self.corrupt = status != Status.INITIAL
            return
        self.corrupt = False
        value = self._unpack(frame.data)
        self.invalid = not self._plausible(value)
        if not self.invalid:
            self.value = value
            self.is_new = True
            self._age_periods = 0
            self.stale = False
