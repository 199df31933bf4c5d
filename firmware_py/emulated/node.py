"""The controller node on an emulated processor: the same bus, the same interrupts, the exported C inside."""

import numpy as np

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.node import NOTHING, Actions, next_period
from dbc.packet import answer_by_entry_points
from firmware_py import entry_points
from firmware_py import task_layout as at
from firmware_py.calibration import flashed
from firmware_py.chosen_firmware import FirmwareError
from firmware_py.contract_words import contract_words
from firmware_py.emulated.image import Image
from firmware_py.emulated.machine import Machine
from firmware_py.kernel import layout as k
from firmware_py.node import Controller, execution_time

CAN = 0x40006400
TO_SEND = CAN + 16
_STATE = at.MAILBOXES_SIZE + at.TASK_SIZE
_IO = _STATE + k.ST_SIZE
_CONTROLLER_WORDS = _IO + k.IO_SIZE
_EXECUTION_TIME = at.MAILBOXES_SIZE + at.EXECUTION_TIME


class EmulatedController(Controller):
    """The firmware as exported, compiled and linked, behind the node's entry points.

    Parameters
    ----------
    contract : Contract
        The DBC; what the C was exported from, if it says the same.
    calibration_block : bytes
        What is flashed; a damaged one keeps the controller in power-on.
    processor : str
        One of `firmware_py.emulated.processors.TARGETS`.
    image : Image
        What it runs.
    execution_ns : int
        From the timer to transmission.

    Attributes
    ----------
    machine : Machine
        The processor.

    Raises
    ------
    FirmwareError
        If the contract differs from the one that the C was exported from.
    """

    def __init__(
        self, contract: Contract, calibration_block: bytes, processor: str, image: Image, execution_ns: int
    ) -> None:
        super().__init__(contract, calibration_block, execution_ns)
        if not np.array_equal(contract_words(contract), contract_words(Contract.load())):
            raise FirmwareError(
                f"the image for {processor} was built from the packaged DBC, not from this one: "
                "use --firmware python with it"
            )
        self.machine = Machine(processor, image)
        self.machine.write(image.symbols["ddh_calibration"], flashed(calibration_block))
        self._address = image.symbols["controller"]

    def on_start(self, now_ns: int) -> Actions:
        """Power-on with the calibration that is flashed."""
        self.machine.start()
        self.machine.write_words(self._address + 4 * _EXECUTION_TIME, [execution_time(self._execution_ns)])
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Receive interrupt."""
        self.machine.write_words(CAN, (frame.can_id, frame.dlc, frame.data, frame.data >> 32))
        self.machine.call("can_receive_handler")
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Timer interrupt."""
        self.machine.call("timer_handler")
        words = self.machine.read_words(self._address, _CONTROLLER_WORDS)
        task, state, io = words[at.MAILBOXES_SIZE : _STATE], words[_STATE:_IO], words[_IO:]
        entry_points.fill_row(self._row, now_ns, task, state, io)
        self.record.append(self._row)
        return Actions(next_period(now_ns + 1), self._sent_frames(now_ns + self._execution_ns))

    def answer(self, packet: memoryview, answer: bytearray) -> int:
        """Answer an event by the entry points; see `dbc.packet`."""
        return answer_by_entry_points(self, packet, answer)

    def _sent_frames(self, send_ns: int) -> tuple[tuple[int, Frame], ...]:
        words = self.machine.read_words(TO_SEND, 1 + at.MAX_FRAMES * at.FRAME_SIZE)
        count, *sent = (word & 0xFFFF_FFFF for word in words)
        messages = (sent[n * at.FRAME_SIZE : (n + 1) * at.FRAME_SIZE] for n in range(count))
        return tuple(
            (send_ns, Frame(can_id, length, low | high << 32)) for can_id, length, low, high in messages
        )
