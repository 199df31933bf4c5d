"""Interpreted with every width checked, and compiled: the same bits, whatever the inputs."""

import pytest
from kernel_runs import CheckedController
from kernel_segments import run_compiled, segments


def assert_bit_exact(kernel_modules, steps, seed):
    for number, segment in enumerate(segments(steps, seed)):
        states, outputs = (array.tolist() for array in run_compiled(segment))
        setpoints, positions = segment.setpoints.tolist(), segment.positions.tolist()
        checked = CheckedController(kernel_modules, segment.calibration, segment.law, positions[0])
        for tick, (setpoint, position) in enumerate(zip(setpoints, positions, strict=True)):
            checked.step(setpoint, position)
            assert checked.state == states[tick], (number, tick)
            assert checked.io == outputs[tick], (number, tick)


def test_a_hundred_thousand_steps(kernel_modules):
    assert_bit_exact(kernel_modules, 100_000, seed=20201120)


@pytest.mark.long
def test_a_million_steps(kernel_modules):
    assert_bit_exact(kernel_modules, 1_000_000, seed=64)
