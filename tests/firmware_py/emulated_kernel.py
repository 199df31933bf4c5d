"""The exported kernel on an emulated processor, a whole segment in one call."""

import numpy as np
from kernel_segments import Segment

from firmware_py.emulated.image import reference_image
from firmware_py.emulated.machine import SCRATCH, Machine
from firmware_py.kernel import layout as k

WORDS_OUT = k.ST_SIZE + k.IO_SIZE
HEAD, CALIBRATION, INPUTS, OUTPUTS = (SCRATCH[0] + offset for offset in (0, 0x1000, 0x2000, 0x100000))


class EmulatedKernel:
    """A processor with the firmware's image."""

    def __init__(self, processor: str) -> None:
        self.machine = Machine(processor, reference_image(processor))

    def run(self, segment: Segment) -> np.ndarray:
        """State and io after each step, a row each."""
        calibration, law, setpoints, positions = segment
        steps = len(setpoints)
        self.machine.write_words(HEAD, (steps, law, CALIBRATION, INPUTS, OUTPUTS))
        self.machine.write(CALIBRATION, calibration.array().tobytes())
        self.machine.write(INPUTS, np.column_stack((setpoints, positions)).astype(np.int32).tobytes())
        self.machine.call("run_segment", HEAD)
        rows = np.frombuffer(self.machine.read(OUTPUTS, 4 * WORDS_OUT * steps), np.int32)
        return rows.reshape(steps, WORDS_OUT)
