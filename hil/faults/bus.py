"""Faults on the bus: what happens to frames and nodes between controllers and the wire."""

from dataclasses import dataclass
from typing import ClassVar

from dbc.frame import Frame
from hil.bus.wire import FrameFault
from hil.faults.fault import (
    LONGEST_S,
    FaultError,
    LastingWireFault,
    Stage,
    WireFault,
    choice,
    number,
    whole_ns,
)
from hil.faults.names import NODES, SIDES, messages


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFaultBase(WireFault):
    """One that befalls the next frames of a message, whoever sends it."""

    fault: ClassVar[FrameFault]

    message: str = choice(*messages(), called="any on the bus")
    count: int = number(1, 1_000_000, "frames", default=1)

    def begin(self, stage: Stage) -> None:
        """Let it befall what is sent from now on."""
        can_id = stage.contract.message(self.message).can_id
        self.wire(stage).spoil(can_id, self.fault, self.argument, self.count)

    @property
    def argument(self) -> int:
        """Argument of the frame fault."""
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drop(FrameFaultBase):
    """The next frames of a message are lost."""

    kind: ClassVar[str] = "drop"
    fault: ClassVar[FrameFault] = FrameFault.DROP


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay(FrameFaultBase):
    """The next frames of a message are handed over later; what follows may overtake them."""

    kind: ClassVar[str] = "delay"
    fault: ClassVar[FrameFault] = FrameFault.DELAY

    delay_s: float = number(0.0, 10.0, "s")

    @property
    def argument(self) -> int:
        """The delay, ns."""
        return whole_ns(self.delay_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrupt(FrameFaultBase):
    """A payload bit of the next frames of a message is flipped, behind CAN's own CRC."""

    kind: ClassVar[str] = "corrupt"
    fault: ClassVar[FrameFault] = FrameFault.CORRUPT

    bit: int = number(0, 63, "")

    def check(self, stage: Stage) -> None:
        """Refuse a bit that the message has not."""
        bits = 8 * stage.contract.message(self.message).dlc
        if self.bit >= bits:
            raise FaultError(f"corrupt: {self.message} has bits 0 to {bits - 1}, not {self.bit}", "bit")
        self.wire(stage)

    @property
    def argument(self) -> int:
        """The bit, byte 0 in the low eight."""
        return 1 << self.bit


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeat(FrameFaultBase):
    """The next frames of a message carry the payload of the last one, counter and CRC included."""

    kind: ClassVar[str] = "repeat"
    fault: ClassVar[FrameFault] = FrameFault.REPEAT


@dataclass(frozen=True, slots=True, kw_only=True)
class Destroy(FrameFaultBase):
    """The next attempts to send a message are hit by a bad bit: error frames end them, others follow."""

    kind: ClassVar[str] = "destroy"
    fault: ClassVar[FrameFault] = FrameFault.DESTROY

    bit: int = number(0, 129, "", default=20)

    @property
    def argument(self) -> int:
        """The bit, 0 being the start of the frame."""
        return self.bit


@dataclass(frozen=True, slots=True, kw_only=True)
class BitErrors(WireFault):
    """Every bit on the wire is bad with a probability, for some time; only the newest burst goes on."""

    kind: ClassVar[str] = "bit_errors"

    rate: float = number(1e-9, 0.5, "")
    duration_s: float = number(1e-6, LONGEST_S, "s")
    seed: int = number(0, 2**63 - 1, "", default=0)

    def begin(self, stage: Stage) -> None:
        """Let there be noise."""
        self.wire(stage).disturb(self.rate, whole_ns(self.duration_s), self.seed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Babble(WireFault):
    """A faulty sender, none of the nodes, sends again and again; it keeps the rules of arbitration."""

    kind: ClassVar[str] = "babble"

    can_id: int = number(0, 0x7FF, "(11-bit identifier)", default=0)
    gap_us: float = number(0.0, 1e6, "µs", default=0.0)
    duration_s: float = number(1e-6, LONGEST_S, "s")

    def begin(self, stage: Stage) -> None:
        """Let it babble, eight bytes at a time."""
        frame = Frame(self.can_id, 8, 0)
        self.wire(stage).babble(frame, round(self.gap_us * 1e3), whole_ns(self.duration_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOff(WireFault):
    """A node's CAN controller goes bus-off, and recovers after 128 sequences of 11 recessive bits."""

    kind: ClassVar[str] = "bus_off"

    node: str = choice(*NODES)

    def begin(self, stage: Stage) -> None:
        """Take it off the bus."""
        self.wire(stage).force_bus_off(self.port(stage, self.node))


@dataclass(frozen=True, slots=True, kw_only=True)
class CutOff(LastingWireFault):
    """A node's cable is broken: it goes on, but neither hears nor is heard."""

    kind: ClassVar[str] = "cut_off"

    node: str = choice(*NODES)

    def begin(self, stage: Stage) -> None:
        """Break it."""
        self.wire(stage).unplug(self.port(stage, self.node))

    def end(self, stage: Stage) -> None:
        """Mend it."""
        self.wire(stage).plug_in(self.port(stage, self.node))


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerOff(LastingWireFault):
    """A node has no power; when it comes back, it starts anew."""

    kind: ClassVar[str] = "power_off"

    node: str = choice(*SIDES)

    def begin(self, stage: Stage) -> None:
        """Cut the power."""
        self.wire(stage).detach(self.port(stage, self.node))

    def end(self, stage: Stage) -> None:
        """Power it on."""
        wire, port = self.wire(stage), self.port(stage, self.node)
        wire.reconnect(port)
        wire.start(port)
