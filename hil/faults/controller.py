"""Faults of a node's own running: reset, clock, late and long periods."""

from dataclasses import dataclass
from typing import ClassVar

from dbc.frame import Frame
from dbc.node import Actions
from hil.faults.fault import LastingWireFault, Stage, WireFault, choice, number
from hil.faults.names import SIDES

LONGEST_LATENESS_US = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Reset(WireFault):
    """A node is reset: it forgets everything and starts anew."""

    kind: ClassVar[str] = "reset"

    node: str = choice(*SIDES, default="controller")

    def begin(self, stage: Stage) -> None:
        """Take the power away and give it back."""
        wire, port = self.wire(stage), self.port(stage, self.node)
        wire.detach(port)
        wire.reconnect(port)
        wire.start(port)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockDrift(LastingWireFault):
    """A node's clock runs fast, or with a negative drift slowly."""

    kind: ClassVar[str] = "clock_drift"

    drift_ppm: float = number(-100_000.0, 100_000.0, "ppm")
    node: str = choice(*SIDES, default="controller")

    def begin(self, stage: Stage) -> None:
        """Drift from now on."""
        self.wire(stage).set_drift(self.port(stage, self.node), round(self.drift_ppm * 1e3))

    def end(self, stage: Stage) -> None:
        """Run at the right pace from now on; what has come together stays."""
        self.wire(stage).set_drift(self.port(stage, self.node), 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LatePeriod(WireFault):
    """The next timer calls of a node come late."""

    kind: ClassVar[str] = "late_period"

    late_us: float = number(0.001, LONGEST_LATENESS_US, "µs")
    count: int = number(1, 1_000_000, "periods", default=1)
    node: str = choice(*SIDES, default="controller")

    def begin(self, stage: Stage) -> None:
        """Put off the call that is due next, and those that the node asks for then."""
        wire, port = self.wire(stage), self.port(stage, self.node)
        late_ns, left = round(self.late_us * 1e3), self.count - 1

        def edit(actions: Actions) -> Actions:
            nonlocal left
            if actions.wake_ns is None:
                return actions
            left -= 1
            if left <= 0:
                wire.stop_editing(port, edit)
            return actions._replace(wake_ns=actions.wake_ns + late_ns)

        wire.put_off(port, late_ns)
        if left:
            wire.edit(port, edit)


@dataclass(frozen=True, slots=True, kw_only=True)
class LongExecution(WireFault):
    """A node takes longer for its next periods: what it sends in them comes later."""

    kind: ClassVar[str] = "long_execution"

    extra_us: float = number(0.001, LONGEST_LATENESS_US, "µs")
    count: int = number(1, 1_000_000, "periods", default=1)
    node: str = choice(*SIDES, default="controller")

    def begin(self, stage: Stage) -> None:
        """Put off what it sends."""
        wire, port = self.wire(stage), self.port(stage, self.node)
        extra_ns, left = round(self.extra_us * 1e3), self.count

        def later(send_ns: int, frame: Frame) -> tuple[int, Frame]:
            return send_ns + extra_ns, frame

        def edit(actions: Actions) -> Actions:
            nonlocal left
            if not actions.sends:
                return actions
            left -= 1
            if left == 0:
                wire.stop_editing(port, edit)
            return actions._replace(sends=tuple(later(*send) for send in actions.sends))

        wire.edit(port, edit)
