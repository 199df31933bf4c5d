"""Worst-case response times of CAN messages.

R. Davis, A. Burns, R. Bril, J. Lukkien: "Controller Area Network (CAN) schedulability analysis: refuted,
revisited and revised", Real-Time Systems 35 (2007), section 3: the earlier analysis of 1994 is optimistic
where a message's busy period spans several of its instances.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

from hil.bus.wire import DEFAULT_DATA_BIT_RATE
from hil.bus.wire_core import arbitration_key

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Traffic:
    """A message that is sent again and again.

    Attributes
    ----------
    name : str
        For tables.
    can_id : int
        Identifier, `dbc.frame.EFF_FLAG` set for a 29-bit one; the priority.
    bits : int
        Longest frame, stuff bits and intermission included; of a CAN FD frame the part at the nominal rate.
    period_ns : int or None
        Shortest time between two instances; None if there is no such limit.
    jitter_ns : int
        Longest time from an instance's event to its frame being ready to send.
    deadline_ns : int or None
        Latest end of the frame after the event; None means the period, if there is one.
    data_bits : int
        The rest of a CAN FD frame, at the data bit rate.
    """

    name: str
    can_id: int
    bits: int
    period_ns: int | None
    jitter_ns: int = 0
    deadline_ns: int | None = None
    data_bits: int = 0

    def duration_ns(self, bit_rate: int, data_bit_rate: int) -> Fraction:
        """Return how long the longest frame takes."""
        return NS_PER_S * (Fraction(self.bits, bit_rate) + Fraction(self.data_bits, data_bit_rate))

    @property
    def due_ns(self) -> int | None:
        """The deadline that counts."""
        return self.period_ns if self.deadline_ns is None else self.deadline_ns


@dataclass(frozen=True, slots=True)
class ResponseTime:
    """What the analysis says of a message.

    Attributes
    ----------
    traffic : Traffic
        The message.
    duration_ns : int
        Longest frame at the bit rate.
    blocking_ns : int
        Longest frame of lower priority that may have just begun.
    worst_ns : int or None
        Longest time from the event to the end of the frame's intermission; None if there is no bound.
    instances : int
        Instances in the busy period, each of which may be the worst.
    """

    traffic: Traffic
    duration_ns: int
    blocking_ns: int
    worst_ns: int | None
    instances: int

    @property
    def met(self) -> bool | None:
        """Whether every instance meets its deadline; None if it has none."""
        if self.traffic.due_ns is None:
            return None
        return self.worst_ns is not None and self.worst_ns <= self.traffic.due_ns


def load(messages: Iterable[Traffic], bit_rate: int, data_bit_rate: int = DEFAULT_DATA_BIT_RATE) -> Fraction:
    """Return the share of bus time that the messages with a period take at most."""
    shares = (m.duration_ns(bit_rate, data_bit_rate) / m.period_ns for m in messages if m.period_ns)
    return sum(shares, Fraction(0))


def response_times(
    messages: Iterable[Traffic], bit_rate: int, data_bit_rate: int = DEFAULT_DATA_BIT_RATE
) -> list[ResponseTime]:
    """Return the worst case of each message, in order of priority.

    A message without a period blocks those above it; below it, and for itself, there is no bound.

    Parameters
    ----------
    messages : iterable of Traffic
        All that is sent on the bus.
    bit_rate, data_bit_rate : int
        Bit/s; the latter of CAN FD data.

    Raises
    ------
    ValueError
        If two messages have one identifier, or a period is not positive.
    """
    ordered = sorted(messages, key=lambda message: int(arbitration_key(message.can_id)))
    for message, following in pairwise(ordered):
        if message.can_id == following.can_id:
            raise ValueError(f"{message.name} and {following.name} have one identifier {message.can_id:#x}")
    if wrong := [message for message in ordered if message.period_ns is not None and message.period_ns <= 0]:
        raise ValueError(f"{wrong[0].name} has a period of {wrong[0].period_ns} ns, must be positive")
    return [_worst_case(ordered, rank, bit_rate, data_bit_rate) for rank in range(len(ordered))]


def _worst_case(ordered: Sequence[Traffic], rank: int, bit_rate: int, data_bit_rate: int) -> ResponseTime:
    durations = [math.ceil(message.duration_ns(bit_rate, data_bit_rate)) for message in ordered]
    bit_ns = -(-NS_PER_S // bit_rate)
    this, duration_ns = ordered[rank], durations[rank]
    blocking_ns = max(durations[rank + 1 :], default=0)
    competing = [  # those above it and itself: period, jitter, duration
        (message.period_ns, message.jitter_ns, cost_ns)
        for message, cost_ns in zip(ordered[: rank + 1], durations, strict=False)
        if message.period_ns is not None
    ]
    if len(competing) <= rank or load(ordered[: rank + 1], bit_rate, data_bit_rate) >= 1:
        return ResponseTime(this, duration_ns, blocking_ns, None, 0)
    period_ns, higher = competing[-1][0], competing[:-1]

    def interference_ns(over_ns: int, competing: Iterable[tuple[int, int, int]]) -> int:
        return sum(
            -(-(over_ns + jitter_ns) // every_ns) * cost_ns for every_ns, jitter_ns, cost_ns in competing
        )

    busy_ns, before_ns = duration_ns, 0
    while busy_ns != before_ns:
        before_ns = busy_ns
        busy_ns = blocking_ns + interference_ns(before_ns, competing)
    instances = -(-(busy_ns + this.jitter_ns) // period_ns)

    worst_ns = 0
    waiting_ns = blocking_ns
    for instance in range(instances):
        before_ns = -1
        while waiting_ns != before_ns:
            before_ns = waiting_ns
            queued_ns = interference_ns(before_ns + bit_ns, higher)
            waiting_ns = blocking_ns + instance * duration_ns + queued_ns
        response_ns = this.jitter_ns + waiting_ns - instance * period_ns + duration_ns
        worst_ns = max(worst_ns, response_ns)
        waiting_ns += duration_ns
    return ResponseTime(this, duration_ns, blocking_ns, worst_ns, instances)
