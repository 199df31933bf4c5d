"""Faults of a message at its sender, before the wire.

Where a signal or the counter is at fault, the CRC is that of what is sent, as it would be if the sender
itself were wrong; where the protection is, it is not.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any, ClassVar

from dbc.codec import MessageCodec
from dbc.frame import Frame
from dbc.node import Actions
from dbc.profile2 import MAX_COUNTER
from hil.faults.fault import FaultError, Stage, WireFault, choice, name, number
from hil.faults.names import PROTECTED, messages, sender, signals

Change = Callable[[int, int], tuple[int, ...]]
"""From send time (ns of the sender) and payload to the payloads that are sent instead."""

_FURTHEST = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageFault(WireFault):
    """One that changes the next frames of a message before they are handed over."""

    message: str = choice(*messages(), called="any on the bus")
    count: int = number(1, 1_000_000, "frames", default=1)

    @abstractmethod
    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Return what becomes of the frames, one call for each."""

    @property
    def concerned(self) -> str:
        """The message's sender."""
        return sender(self.message)

    def begin(self, stage: Stage) -> None:
        """Come between the sender and the wire, for as long as it takes."""
        wire, port = self.wire(stage), self.port(stage, self.concerned)
        codec = stage.contract.message(self.message)
        change, left = self.change(codec), self.count

        def edit(actions: Actions) -> Actions:
            nonlocal left
            sends: list[tuple[int, Frame]] = []
            for send_ns, frame in actions.sends:
                if frame.can_id == codec.can_id and left:
                    left -= 1
                    sends += [(send_ns, codec.frame(data)) for data in change(send_ns, frame.data)]
                else:
                    sends.append((send_ns, frame))
            if not left:
                wire.stop_editing(port, edit)
            return Actions(actions.wake_ns, tuple(sends))

        wire.edit(port, edit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Duplicate(MessageFault):
    """The next frames of a message are sent twice."""

    kind: ClassVar[str] = "duplicate"

    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Send each twice."""
        return lambda _, data: (data, data)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtectionFault(MessageFault):
    """One of counter or CRC."""

    message: str = choice(*PROTECTED, called="any with counter and CRC")


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongCrc(ProtectionFault):
    """The E2E CRC of the next frames of a message is wrong."""

    kind: ClassVar[str] = "wrong_crc"

    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Invert the CRC."""
        return lambda _, data: (data ^ 0xFF,)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrozenCounter(ProtectionFault):
    """The E2E counter of a message stays as it was; the CRC is right."""

    kind: ClassVar[str] = "frozen_counter"

    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Send the counter of the frame before the first one."""
        frozen: list[int] = []

        def change(_: int, data: int) -> tuple[int, ...]:
            if not frozen:
                frozen.append(_counter(data) - 1 & MAX_COUNTER)
            return (_with_counter(codec, data, frozen[0]),)

        return change


@dataclass(frozen=True, slots=True, kw_only=True)
class JumpingCounter(ProtectionFault):
    """The E2E counter of the next frames of a message is ahead of itself; the CRC is right."""

    kind: ClassVar[str] = "jumping_counter"

    jump: int = number(1, MAX_COUNTER, "")

    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Add to the counter."""
        return lambda _, data: (_with_counter(codec, data, _counter(data) + self.jump & MAX_COUNTER),)


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalFault(MessageFault):
    """One of a signal; counter and CRC are right."""

    signal: str = name("a signal of the message")

    def __post_init__(self) -> None:
        MessageFault.__post_init__(self)
        if self.signal not in (known := signals(self.message)):
            said = f"{self.kind}: {self.message} has no signal {self.signal!r}: choose one of "
            raise FaultError(said + ", ".join(known), "signal")

    @abstractmethod
    def raw(self, raw_per_unit: float) -> Callable[[int, int], int]:
        """Return what gives the wrong raw value from send time (ns) and the right one."""

    def change(self, codec: MessageCodec[..., Any]) -> Change:
        """Put the wrong value in its place, as near as the signal's length allows."""
        signal = codec.signals[self.signal]
        mask = (1 << signal.length) - 1
        low = -(1 << signal.length - 1) if signal.signed else 0
        wrong = self.raw(1.0 / signal.factor)

        def change(send_ns: int, data: int) -> tuple[int, ...]:
            right = ((data >> signal.start & mask) - low & mask) + low
            value = min(max(wrong(send_ns, right), low), low + mask)
            changed = data & ~(mask << signal.start) | (value & mask) << signal.start
            return (_protected(codec, changed),)

        return change


@dataclass(frozen=True, slots=True, kw_only=True)
class FrozenSignal(SignalFault):
    """A signal of a message stays as it is; counter and CRC go on."""

    kind: ClassVar[str] = "frozen_signal"

    def raw(self, raw_per_unit: float) -> Callable[[int, int], int]:
        """Keep the first one."""
        kept: list[int] = []

        def raw(_: int, right: int) -> int:
            kept.append(right) if not kept else None
            return kept[0]

        return raw


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalOffset(SignalFault):
    """A signal of a message is off by a constant, in the signal's unit."""

    kind: ClassVar[str] = "signal_offset"

    offset: float = number(-_FURTHEST, _FURTHEST, "of the signal's unit")

    def raw(self, raw_per_unit: float) -> Callable[[int, int], int]:
        """Add the offset."""
        offset = round(self.offset * raw_per_unit)
        return lambda _, right: right + offset


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalRamp(SignalFault):
    """A signal of a message runs away, in the signal's unit per second."""

    kind: ClassVar[str] = "signal_ramp"

    rate_per_s: float = number(-_FURTHEST, _FURTHEST, "of the signal's unit per s")

    def raw(self, raw_per_unit: float) -> Callable[[int, int], int]:
        """Add what has come together since the first frame."""
        begin: list[int] = []

        def raw(send_ns: int, right: int) -> int:
            begin.append(send_ns) if not begin else None
            return right + round(self.rate_per_s * (send_ns - begin[0]) * 1e-9 * raw_per_unit)

        return raw


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSignal(SignalFault):
    """A signal of a message is random, evenly between two values in the signal's unit."""

    kind: ClassVar[str] = "random_signal"

    low: float = number(-_FURTHEST, _FURTHEST, "of the signal's unit")
    high: float = number(-_FURTHEST, _FURTHEST, "of the signal's unit")
    seed: int = number(0, 2**63 - 1, "", default=0)

    def __post_init__(self) -> None:
        SignalFault.__post_init__(self)
        if self.high < self.low:
            raise FaultError(f"random_signal: high is {self.high}, must be {self.low} or more", "high")

    def raw(self, raw_per_unit: float) -> Callable[[int, int], int]:
        """Draw."""
        low, high, random = round(self.low * raw_per_unit), round(self.high * raw_per_unit), Random(self.seed)
        return lambda _, __: random.randint(low, high)


def _counter(data: int) -> int:
    return data >> 8 & MAX_COUNTER


def _with_counter(codec: MessageCodec[..., Any], data: int, counter: int) -> int:
    return _protected(codec, data & ~(MAX_COUNTER << 8) | counter << 8)


def _protected(codec: MessageCodec[..., Any], data: int) -> int:
    """Return a payload with the CRC that belongs to it and its counter; as it is if it carries none."""
    return data if codec.data_ids is None else codec.with_crc(data)
