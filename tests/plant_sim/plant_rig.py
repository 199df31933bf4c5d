"""A plant node and the one who talks to it."""

import math

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand
from dbc.node import NOTHING
from plant_sim.drive import State
from plant_sim.node import Plant
from plant_sim.parameters import NOMINAL, PlantParameters
from plant_sim.sensors import PositionSensor

CONTRACT = Contract.load()
PERIOD_NS = 1_000_000
SHUTDOWN, SWITCH_ON, ENABLE = 0x06, 0x07, 0x0F
COUNTS_PER_RPM = 4
RAD_S_PER_COUNT = math.pi / 30 / COUNTS_PER_RPM


class Rig:
    """A plant and the one who commands it, one call per period."""

    def __init__(
        self,
        sensor: PositionSensor | None = None,
        delay_periods: int = 1,
        parameters: PlantParameters = NOMINAL,
    ) -> None:
        self.plant = Plant(CONTRACT, parameters, sensor, delay_periods)
        self.now_ns = 0
        self.sent: list[tuple[int, Frame]] = []
        self._protect = CONTRACT.drive_command.protector().protect
        assert self.plant.on_start(0).wake_ns == 0

    def hear(self, frame: Frame) -> None:
        assert self.plant.on_frame(self.now_ns - PERIOD_NS // 3, frame) is NOTHING

    def command_frame(self, controlword: int, counts: int) -> Frame:
        command = CONTRACT.drive_command
        return command.frame(self._protect(command.pack(controlword, counts)))

    def period(self, counts: int | None = None, controlword: int = ENABLE) -> dict[str, float]:
        """Deliver a DriveCommand, unless `counts` is None, fire the timer, and return the period's record."""
        if counts is not None:
            self.hear(self.command_frame(controlword, counts))
        wake_ns, sends = self.plant.on_timer(self.now_ns)
        assert wake_ns == self.now_ns + PERIOD_NS
        self.sent = list(sends)
        self.now_ns = wake_ns
        return {name: column[-1] for name, column in self.plant.record.columns_by_name().items()}

    def decoded(self, name: str) -> tuple[int, ...] | None:
        """Return what the message of that name, if sent in the last period, says."""
        codec = getattr(CONTRACT, name)
        found = [codec.unpack(frame.data) for _, frame in self.sent if frame.can_id == codec.can_id]
        assert len(found) <= 1
        return found[0] if found else None

    def bench_reset(self, position_m: float) -> None:
        self._bench_control(BenchCommand.RESET, 0, round(position_m / 1e-7))

    def load(self, force_n: int) -> None:
        self.hear(CONTRACT.bench_load.frame(CONTRACT.bench_load.pack(force_n)))

    def fault(self, fault: int, value: float = 1.0) -> None:
        self._bench_control(BenchCommand.SET_FAULT, fault, round(value * 1e6))

    def scale(self, parameter: int, factor: float) -> None:
        self._bench_control(BenchCommand.SCALE_PARAMETER, parameter, round(factor * 1e6))

    def enable(self, position_m: float) -> dict[str, float]:
        """Put the rod there at rest and bring the drive to Operation enabled."""
        self.bench_reset(position_m)
        for controlword in (SHUTDOWN, SHUTDOWN, SWITCH_ON, ENABLE):
            record = self.period(0, controlword)
        assert record["drive_state"] == State.OPERATION_ENABLED
        return record

    def _bench_control(self, command: int, identifier: int, value: int) -> None:
        bench = CONTRACT.bench_control
        self.hear(bench.frame(bench.pack(command, identifier, value)))
