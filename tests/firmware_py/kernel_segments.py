"""Inputs that show differences between the machines of the kernel, and what compiled code makes of them."""

from collections.abc import Iterator
from typing import NamedTuple

import numba
import numpy as np

from firmware_py.calibration import VALUE_RANGES, Calibration
from firmware_py.calibration_block import GAINS, MAX_SHIFT, MIN_SHIFT, ZONES
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22
from firmware_py.kernel.fixedpoint import INT32_MAX
from firmware_py.tuning import AdrcTuning, LimiterTuning, PiTuning, Tuning

SEGMENT_STEPS = 100
EXTREMES = np.array([-(2**31), -(2**31) + 1, -1, 0, 1, 2**31 - 1])
LAWS = (k.LAW_P, k.LAW_PI, k.LAW_ADRC, k.LAW_PI_FF, k.LAW_SCHEDULED, k.LAW_SCHEDULED, 0)


class Segment(NamedTuple):
    """A reset, then one step for each pair of inputs.

    Attributes
    ----------
    calibration : Calibration
    law : int
    setpoints, positions : array of int32
        0.1 um, 1 um.
    """

    calibration: Calibration
    law: int
    setpoints: np.ndarray
    positions: np.ndarray


@numba.njit
def _run(calibration, state, io, setpoints, positions, states, outputs):
    control_reset(calibration, state, io)
    for tick in range(setpoints.size):
        io[k.IO_SETPOINT] = setpoints[tick]
        io[k.IO_POSITION] = positions[tick]
        control_step(calibration, state, io)
        states[tick] = state
        outputs[tick] = io


def run_compiled(segment: Segment) -> tuple[np.ndarray, np.ndarray]:
    """States and io after each step, a row each."""
    calibration, law, setpoints, positions = segment
    io = np.zeros(k.IO_SIZE, np.int32)
    io[k.IO_LAW] = law
    io[k.IO_POSITION] = positions[0]
    states = np.empty((setpoints.size, k.ST_SIZE), np.int32)
    outputs = np.empty((setpoints.size, k.IO_SIZE), np.int32)
    state = np.zeros(k.ST_SIZE, np.int32)
    _run(calibration.array(), state, io, setpoints, positions, states, outputs)
    return states, outputs


def any_legal_calibration(rng):
    """Every word anywhere in its legal range, small and large alike."""
    words = np.zeros(k.CAL_SIZE, np.int64)
    for index in GAINS:
        words[index] = rng.integers(-INT32_MAX, INT32_MAX, endpoint=True) >> rng.integers(0, 31)
        words[index + 1] = rng.integers(MIN_SHIFT, MAX_SHIFT, endpoint=True)
    for index, (low, high) in VALUE_RANGES.items():
        words[index] = max(low, high >> rng.integers(0, high.bit_length()))
    for index in ZONES:
        words[index + 1] = log2_q22(int(words[index]))
    return Calibration(k.LAW_ADRC, tuple(words.tolist()))


def a_plausible_calibration(rng):
    """Physical gains within a factor of three of the nominal ones."""

    def near(value):
        return value * 3.0 ** rng.uniform(-1, 1)

    return Tuning(
        p=PiTuning(near(31_100)),
        pi=PiTuning(near(27_270), near(39_900)),
        adrc=AdrcTuning(
            r0_m_s2=near(25.0),
            h0_s=rng.uniform(2e-3, 5e-3),
            omega_o_rad_s=near(200.0),
            b0_m_s2_per_rad=near(70.0),
            a1n_per_s2=-near(5e4),
            a2n_per_s=-near(10.0),
            omega_c_rad_s=near(180.0),
        ),
        limiter=LimiterTuning(near(0.14), near(1.0)),
    ).calibration()


def extreme_signal(rng):
    """Anything in 32 bits, its ends included."""
    anything = rng.integers(-(2**31), 2**31, SEGMENT_STEPS)
    return np.where(rng.random(SEGMENT_STEPS) < 0.2, rng.choice(EXTREMES, SEGMENT_STEPS), anything)


def stepping_signal(rng, counts_per_metre):
    """Holds and jumps within the stroke."""
    levels = rng.integers(0, int(0.4 * counts_per_metre), SEGMENT_STEPS)
    return levels[np.cumsum(rng.random(SEGMENT_STEPS) < 0.1)]


def wandering_signal(rng, counts_per_metre):
    """A random walk of up to 0.14 m/s within the stroke."""
    walk = np.cumsum(rng.integers(-1, 2, SEGMENT_STEPS) * int(0.14e-3 * counts_per_metre))
    return walk + rng.integers(0, int(0.4 * counts_per_metre))


def segments(steps: int, seed: int) -> Iterator[Segment]:
    """Yield segments of `SEGMENT_STEPS`: extremes, jumps and walks, plausible and any legal calibrations."""
    rng = np.random.default_rng(seed)
    for number in range(steps // SEGMENT_STEPS):
        calibration = (a_plausible_calibration, any_legal_calibration)[number % 2](rng)
        law = LAWS[number % len(LAWS)]
        if number % 3 == 0:
            setpoints, positions = extreme_signal(rng), extreme_signal(rng)
        elif number % 3 == 1:
            setpoints, positions = stepping_signal(rng, 1e7), stepping_signal(rng, 1e6)
        else:
            setpoints = wandering_signal(rng, 1e7)
            positions = setpoints // 10 + rng.integers(-200, 200, SEGMENT_STEPS)
        yield Segment(calibration, law, setpoints.astype(np.int32), positions.astype(np.int32))
