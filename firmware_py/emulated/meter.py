"""What a control period costs on a processor: the handlers fed with frames, without a bus."""

from dataclasses import dataclass
from typing import Any

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.node import PERIOD_NS
from firmware_py.calibration import Calibration
from firmware_py.emulated.cycles import Cost
from firmware_py.emulated.image import Image
from firmware_py.emulated.machine import SCRATCH, Machine
from firmware_py.emulated.node import EmulatedController
from firmware_py.kernel import layout as k
from firmware_py.state_machine import RUN

_ENABLED = 0x1237
_LONGEST_BRING_UP = 20
_COMMAND_CYCLE_NS = 100 * PERIOD_NS
_CALIBRATION, _STATE, _IO = (SCRATCH[0] + offset for offset in (0, 0x1000, 0x2000))


@dataclass(frozen=True, slots=True)
class Metered:
    """What one control period cost.

    Attributes
    ----------
    setpoint_0p1um, position_um : int
        What it was fed.
    timer, receive : Cost
        Of the timer interrupt, and of the dearest receive interrupt before it.
    """

    setpoint_0p1um: int
    position_um: int
    timer: Cost
    receive: Cost


class Meter:
    """A processor with the firmware, in the state Run under one control law.

    Parameters
    ----------
    processor : str
        One of `firmware_py.emulated.processors.TARGETS`.
    image : Image
        The program.
    calibration : Calibration
        What it is calibrated with; its control law is the one that runs.
    position_um : int
        Where it begins.
    """

    def __init__(self, processor: str, image: Image, calibration: Calibration, position_um: int) -> None:
        contract = Contract.load()
        self._contract = contract
        self._node = EmulatedController(contract, calibration.to_bytes(), processor, image, 0)
        self._machine = self._node.machine
        self._protect = {
            codec: codec.protector().protect
            for codec in (
                contract.position_feedback,
                contract.position_setpoint,
                contract.controller_command,
                contract.drive_status,
            )
        }
        self._machine.count_costs()
        self._law = calibration.law
        self._now_ns = 0
        self._node.on_start(0)
        self._machine.paint_stack()
        self._bring_up(position_um)

    @property
    def stack_bytes(self) -> int:
        """The stack that the handlers have used so far; what an interrupt itself saves comes on top."""
        return self._machine.stack_bytes()

    def period(self, setpoint_0p1um: int, position_um: int) -> Metered:
        """Run a control period in the state Run."""
        frames = [self._feedback(position_um), self._setpoint(setpoint_0p1um), self._status()]
        if self._now_ns % _COMMAND_CYCLE_NS == 0:
            frames.append(self._command(enable=1))
        receive = self._hear(*frames)
        timer = self._timer()
        return Metered(setpoint_0p1um, position_um, timer, receive)

    def _bring_up(self, position_um: int) -> None:
        for period in range(_LONGEST_BRING_UP):
            self._hear(
                self._feedback(position_um),
                self._setpoint(10 * position_um),
                self._status(),
                self._command(enable=int(period >= _LONGEST_BRING_UP // 2)),
            )
            self._timer()
        if int(self._node.record.columns_by_name()["state"][-1]) != RUN:
            raise AssertionError("the firmware does not come up")

    def _timer(self) -> Cost:
        self._node.on_timer(self._now_ns)
        self._now_ns += PERIOD_NS
        return self._machine.cost

    def _hear(self, *frames: Frame) -> Cost:
        costs = []
        for frame in frames:
            self._node.on_frame(self._now_ns, frame)
            costs.append(self._machine.cost)
        return max(costs, key=lambda cost: cost.high)

    def _feedback(self, position_um: int) -> Frame:
        return self._frame(self._contract.position_feedback, 0, position_um)

    def _setpoint(self, setpoint_0p1um: int) -> Frame:
        return self._frame(self._contract.position_setpoint, setpoint_0p1um)

    def _status(self) -> Frame:
        return self._frame(self._contract.drive_status, _ENABLED, 0)

    def _command(self, enable: int) -> Frame:
        return self._frame(self._contract.controller_command, enable, self._law, 0)

    def _frame(self, codec: Any, *values: int) -> Frame:
        frame: Frame = codec.frame(self._protect[codec](codec.pack(*values)))
        return frame


class StepMeter:
    """A processor with the control law alone.

    Parameters
    ----------
    machine : Machine
        The processor; its costs are counted.
    calibration : Calibration
        Whose law runs.
    position_um : int
        Where it begins.
    """

    def __init__(self, machine: Machine, calibration: Calibration, position_um: int) -> None:
        self._machine = machine
        machine.write_words(_CALIBRATION, calibration.words)
        machine.write_words(_STATE, [0] * k.ST_SIZE)
        machine.write_words(_IO, [0] * k.IO_SIZE)
        machine.write_words(_IO + 4 * k.IO_LAW, [calibration.law])
        machine.write_words(_IO + 4 * k.IO_POSITION, [position_um])
        machine.call("ddh_control_reset", _CALIBRATION, _STATE, _IO)

    def step(self, setpoint_0p1um: int, position_um: int) -> Cost:
        """Run a control step."""
        self._machine.write_words(_IO + 4 * k.IO_SETPOINT, [setpoint_0p1um, position_um])
        self._machine.call("ddh_control_step", _CALIBRATION, _STATE, _IO)
        return self._machine.cost
