"""How long a stuck sensor goes unnoticed while the rod moves, by speed: the motor first has to speed up."""

from pathlib import Path

import numpy as np

from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.diagnosis import State
from hil.bench import Bench
from hil.measure import M_TO_MM
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions

SPEEDS_MM_S = (0.5, 1.0, 10.0, 94.0)
TUNINGS = ("robust", "paper", "pi_ff")

_FROM_M, _TO_M = 0.1, 0.38
_BEFORE_S, _AFTER_S = 0.5, 5.0


def undetected(rig: InprocessRig, speed_mm_s: float) -> tuple[float, float]:
    """Return how long it takes until the safe state, s, and how far the rod gets ahead of its reference, mm.

    Parameters
    ----------
    rig : InprocessRig
        Decides the tuning.
    speed_mm_s : float
        Of the reference, outwards from 100 mm; the sensor gets stuck after half a second.
    """
    bench = Bench(rig, position_m=_FROM_M)
    bench.setpoint(lambda time_s: np.minimum(_FROM_M + speed_mm_s * 1e-3 * time_s, _TO_M))
    bench.run(_BEFORE_S)
    bench.inject("sensor_stuck")
    bench.run(_AFTER_S)
    trace = bench.trace
    safe_s = float(trace["time_s"][trace["controller_state"] == State.SAFE][0])
    return safe_s - _BEFORE_S, float(-trace["error_m"].min() * M_TO_MM)


def markdown() -> str:
    """Return the table of all speeds and tunings."""
    columns = []
    for tuning in TUNINGS:
        with InprocessRig(RigOptions(record_directory=Path(), tuning=chosen_tuning(tuning))) as rig:
            columns.append([undetected(rig, speed) for speed in SPEEDS_MM_S])
    lines = [("speed of the reference", *TUNINGS), ("---:", *("---:" for _ in TUNINGS))]
    for speed, *cells in zip(SPEEDS_MM_S, *columns, strict=True):
        lines.append((f"{speed:g} mm/s", *(f"{time_s:.2f} s, {off_mm:.0f} mm" for time_s, off_mm in cells)))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
