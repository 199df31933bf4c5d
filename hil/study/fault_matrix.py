"""The fault matrix: which faults are played in which phases, and the reaction that is expected of each."""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from typing import Any

import numpy as np

from dbc.codec import signal_name
from firmware_py.diagnosis import Fault as ControllerFault
from hil.faults.catalogue import fault_of_text
from hil.faults.fault import Fault, FaultError
from plant_sim.parameters import NOMINAL

AT_REST_RPM = 1.0
"""Motor speed below which it counts as at rest."""

FRAME_MS = 1.0
"""The command that stops the drive: sent at once, latched with the drive's next cycle."""

ABOUT = 0.3
"""Share by which the error of an undetectable fault may differ from what the matrix says."""

MATRIX_FILE = "fault_matrix.toml"


class MatrixError(ValueError):
    """The matrix makes no sense; one line."""


class Detector(StrEnum):
    """Who is the first to notice."""

    CONTROLLER = "controller"
    """Sets a fault signal: E2E, timeout, plausibility, overrun."""
    DRIVE = "drive"
    """Supervises DriveCommand: fault reaction after three missing or invalid ones."""
    CAN = "CAN"
    """Error counters of the CAN controllers: error frames, bus-off."""
    NOBODY = "nobody"


class Reaction(StrEnum):
    """What becomes of it, in every phase but standby, where it is that nothing moves."""

    SAFE = "safe"
    """The controller goes to its safe state and stops the drive by quick stop."""
    DRIVE_STOP = "drive_stop"
    """The drive stops itself and faults; the controller follows into its safe state."""
    STANDBY = "standby"
    """The controller is in standby again, and the drive disabled."""
    TOLERATED = "tolerated"
    """Control goes on with an error that stays below a bound."""
    UNDETECTED = "undetected"
    """Control goes on with an error that nobody sees."""

    @property
    def stops(self) -> bool:
        """Whether the motor is stopped."""
        return self in (Reaction.SAFE, Reaction.DRIVE_STOP, Reaction.STANDBY)


@dataclass(frozen=True, slots=True)
class Phase:
    """What the machine does when a fault comes.

    Attributes
    ----------
    title : str
        For people.
    reference_m : callable
        Position over time from the start of the phase (s, array), m.
    is_enabled : bool
        Whether the controller runs.
    """

    title: str
    reference_m: Callable[[np.ndarray], np.ndarray]
    is_enabled: bool = True


def _sway(time_s: np.ndarray) -> np.ndarray:
    """Go to and fro by 30 mm at 0.5 Hz: fastest, 94 mm/s, when the fault comes."""
    return 0.15 - 0.03 * np.cos(math.pi * time_s)


PHASES = {
    "standby": Phase("standby", lambda time_s: np.full_like(time_s, 0.2), is_enabled=False),
    "tracking": Phase("tracking", _sway),
    "holding": Phase("holding", lambda time_s: np.full_like(time_s, 0.2)),
    "at_stop": Phase("at the stop", lambda time_s: np.full_like(time_s, 0.0)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What is expected in one phase.

    Attributes
    ----------
    by : Detector
        Who notices first.
    within_ms : float
        The latest that may be, from the fault on, ms; 0 where nobody does.
    trip_ms : float
        The latest that the stop may be decided on, ms; 0 stands for `within_ms`.
    signals : tuple of str
        All fault signals of ControllerStatus that get set.
    reaction : Reaction
    error_mm : float
        Tolerated: bound on the largest deviation from the reference. Undetected: about how far the rod is in
        the end from where it would be without the fault. mm; 0 where the motor is stopped.
    source : str
        Where the detection and its time come from.
    """

    reaction: Reaction
    source: str
    by: Detector = Detector.NOBODY
    within_ms: float = 0.0
    trip_ms: float = 0.0
    signals: tuple[str, ...] = ()
    error_mm: float = 0.0

    def allowed_stop_ms(self, speed_rpm: float) -> float:
        """Return how long after the fault the motor may turn that had `speed_rpm`: the fault-tolerant time.

        Detection, one frame, then the ramp at the drive's deceleration and what the motor's lag adds to it.
        """
        rpm = 30.0 / math.pi
        slope_rpm_s = NOMINAL.motor_acceleration_rad_s2 * rpm
        behind_rpm = min(abs(speed_rpm), slope_rpm_s * NOMINAL.motor_time_constant_s)
        lag_s = NOMINAL.motor_time_constant_s * math.log(max(behind_rpm / AT_REST_RPM, 1.0))
        return (self.trip_ms or self.within_ms) + FRAME_MS + 1e3 * (abs(speed_rpm) / slope_rpm_s + lag_s)


@dataclass(frozen=True, slots=True)
class Case:
    """A fault in a phase.

    Attributes
    ----------
    name : str
        The fault as the matrix has it.
    fault : Fault
    phase : str
        Key of `PHASES`.
    expected : Expectation
    is_drawn : bool
        Whether its course is kept for a picture.
    """

    name: str
    fault: Fault
    phase: str
    expected: Expectation
    is_drawn: bool = False


def load_matrix(text: str | None = None) -> tuple[Case, ...]:
    """Return all cases of a matrix in TOML; by default of the project's own, fault by fault.

    Raises
    ------
    MatrixError
        If a key or a value is not allowed; it names the fault.
    """
    if text is None:
        text = resources.files("hil.study").joinpath(MATRIX_FILE).read_text(encoding="utf-8")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MatrixError(f"fault matrix: {error}") from error
    rows, unharmed_mm = content.get("fault", []), content.get("error_mm", {})
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise MatrixError("fault matrix: faults are tables [[fault]]")
    if not isinstance(unharmed_mm, dict) or not set(unharmed_mm) <= set(PHASES):
        raise MatrixError(f"fault matrix: error_mm is a table with some of {', '.join(PHASES)}")
    return tuple(case for row in rows for case in _cases(row, unharmed_mm))


def _cases(row: Mapping[str, Any], unharmed_mm: Mapping[str, float]) -> list[Case]:
    name = str(row.get("fault", ""))
    try:
        fault = fault_of_text(name)
    except FaultError as error:
        raise MatrixError(f"fault matrix: {error}") from error
    if fault.at_s:
        raise MatrixError(f"fault matrix: {name}: the phase says when, without at_s")
    drawn = row.get("drawn", [])
    if not isinstance(drawn, list) or not set(drawn) <= set(PHASES):
        raise MatrixError(f"fault matrix: {name}: drawn must be a list of some of {', '.join(PHASES)}")
    common = {key: value for key, value in row.items() if key not in ("fault", "drawn", *PHASES)}
    cases = []
    for phase in PHASES:
        own = row.get(phase, {})
        if not isinstance(own, dict):
            raise MatrixError(f"fault matrix: {name}: {phase} must be a table")
        table = common | own
        if table.get("reaction") == Reaction.TOLERATED and phase in unharmed_mm:
            table = {"error_mm": unharmed_mm[phase]} | table
        cases.append(Case(name, fault, phase, _expectation(f"{name} in {phase}", table), phase in drawn))
    return cases


def _expectation(where: str, table: dict[str, Any]) -> Expectation:
    values = {"by": Detector.NOBODY, "signals": []} | table
    known = sorted(signal_name(str(fault.name)) for fault in ControllerFault)
    allowed = {
        "by": (lambda value: value in list(Detector), f"one of {', '.join(Detector)}"),
        "reaction": (lambda value: value in list(Reaction), f"one of {', '.join(Reaction)}"),
        "signals": (
            lambda value: isinstance(value, list) and all(one in known for one in value),
            f"a list of some of {', '.join(known)}",
        ),
        "source": (lambda value: isinstance(value, str), "a text"),
        "within_ms": (_is_magnitude, "a number from 0 on"),
        "trip_ms": (_is_magnitude, "a number from 0 on"),
        "error_mm": (_is_magnitude, "a number from 0 on"),
    }
    for key in ("reaction", "source", *table):
        if key not in allowed:
            raise MatrixError(f"fault matrix: {where}: no key {key!r}, only {', '.join(allowed)}")
        is_allowed, words = allowed[key]
        if not is_allowed(values.get(key)):
            raise MatrixError(f"fault matrix: {where}: {key} is {values.get(key)!r}, must be {words}")
    kinds = {"by": Detector(values["by"]), "reaction": Reaction(values["reaction"])}
    return Expectation(**values | kinds | {"signals": tuple(sorted(values["signals"]))})


def _is_magnitude(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < math.inf
