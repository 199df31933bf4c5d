"""A scenario is data: reference, load profile, duration and the limits the run must meet."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from dbc.node import PERIOD_NS
from hil.faults.catalogue import fault_of_table
from hil.faults.fault import LONGEST_S, Fault, FaultError
from hil.references import REFERENCES
from hil.toml_lines import KeyPath, line_of
from plant_sim.machine import Machine
from plant_sim.parameters import MAX_LOAD_N, ParameterError

CONTROLLERS = ("p", "pi", "adrc", "pi_ff", "scheduled")
PERIOD_S = PERIOD_NS * 1e-9
REQUIRED = ("title", "reference", "duration_s")
OPTIONAL = ("load", "limits", "paper", "timing", "machine", "fault")
FIGURES = ("rms_mm", "max_mm")


def controller_of(law: int) -> str:
    """Return the name of a control law by its number on the bus."""
    return CONTROLLERS[law - 1]


def law_of(controller: str) -> int:
    """Return the number on the bus of a control law by its name."""
    return 1 + CONTROLLERS.index(controller)


class ScenarioError(ValueError):
    """A scenario does not exist or does not make sense; the message says what to do."""


@dataclass(frozen=True, slots=True)
class TimingLimits:
    """Largest values that each control period's timing may have; None is not checked.

    The figures are those of `hil.timing.Timing`: ages, latency and jitter in µs, missed and late periods as
    counts over the scenario.
    """

    feedback_age_us: float | None = None
    setpoint_age_us: float | None = None
    latency_us: float | None = None
    jitter_us: float | None = None
    missed_periods: int | None = None
    late_periods: int | None = None

    def given(self) -> dict[str, float]:
        """Return the limits that are checked."""
        return {name: limit for name, limit in asdict(self).items() if limit is not None}


@dataclass(frozen=True, slots=True)
class Scenario:
    """What the supervisor does to the closed loop, and what must come of it.

    Attributes
    ----------
    name : str
        File name without suffix.
    title : str
        One line for lists.
    reference : str
        Key of `hil.references.REFERENCES`.
    duration_s : float
        Length from the start of the reference, s.
    load : tuple of (float, float)
        Steps of the external load: time (s) and force (N, negative helps extension).
    limits : dict
        For each controller that has to meet one, `rms_mm` and `max_mm`.
    paper : dict
        The paper's figures for each controller, `rms_mm` and `max_mm`; empty if it has none.
    timing : TimingLimits
        Limits on the timing, whichever controller is played.
    machine : Machine
        What it is played on.
    faults : tuple of Fault
        What goes wrong, at times from the start of the reference.
    """

    name: str
    title: str
    reference: str
    duration_s: float
    load: tuple[tuple[float, float], ...]
    limits: dict[str, dict[str, float]]
    paper: dict[str, dict[str, float]]
    timing: TimingLimits = field(default_factory=TimingLimits)
    machine: Machine = field(default_factory=Machine)
    faults: tuple[Fault, ...] = ()

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return round(self.duration_s / PERIOD_S)

    @property
    def initial_m(self) -> float:
        """Where the reference begins, m."""
        return float(self.position_m(np.zeros(1))[0])

    def reference_m(self) -> np.ndarray:
        """Return the reference at the start of each period, m."""
        return self.position_m(np.arange(self.periods) * PERIOD_S)

    def position_m(self, time_s: np.ndarray) -> np.ndarray:
        """Return the reference at given times from its start, m."""
        return REFERENCES[self.reference](time_s)

    @property
    def load_changes(self) -> list[tuple[int, int]]:
        """The load steps as they go over the bus: period in which each begins, and force in whole N."""
        return [(round(time_s * 1e9) // PERIOD_NS, round(force_n)) for time_s, force_n in self.load]

    def load_n(self) -> np.ndarray:
        """Return the load that acts in each period, N."""
        load_n = np.zeros(self.periods)
        for period, force_n in sorted(self.load_changes, key=lambda change: change[0]):
            load_n[period:] = force_n
        return load_n


def builtin_names() -> list[str]:
    """Return the names of the scenarios in the package."""
    files = resources.files("hil.scenarios").iterdir()
    return sorted(Path(file.name).stem for file in files if file.name.endswith(".toml"))


def load_scenario(name: str, duration_s: float | None = None) -> Scenario:
    """Return a built-in scenario by name, or one from a ``.toml`` file.

    Parameters
    ----------
    name : str
        Name or path.
    duration_s : float, optional
        Length to play instead of the scenario's own, s; its limits, the paper's figures and faults that come
        later do not apply then.

    Raises
    ------
    ScenarioError
        If there is none of that name, or a key is missing, unknown or has a wrong value.
    """
    if name.endswith(".toml"):
        path = Path(name)
        if not path.is_file():
            raise ScenarioError(f"there is no scenario file {name}")
        text = path.read_text(encoding="utf-8", errors="replace")
    elif name in builtin_names():
        path = Path(name)
        text = resources.files("hil.scenarios").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    else:
        known = ", ".join(builtin_names())
        raise ScenarioError(f"unknown scenario {name!r}: choose one of {known}, or give a .toml file")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{name}: {error}") from error
    changes: dict[str, Any] = {}
    if duration_s is not None:
        changes = {"limits": {}, "paper": {}, "timing": TimingLimits(), "duration_s": _duration_s(duration_s)}
    try:
        scenario = replace(_checked(path.stem, content), **changes)
    except _WrongKeyError as error:
        line = line_of(text, error.path)
        where = name if line is None else f"{name}: line {line}"
        raise ScenarioError(f"{where}: {error}") from error
    faults = tuple(fault for fault in scenario.faults if fault.at_s < scenario.duration_s)
    return replace(scenario, faults=faults)


class _WrongKeyError(ScenarioError):
    """What is wrong, and where in the file; a key that is missing is looked for in its table."""

    def __init__(self, path: KeyPath, message: str) -> None:
        super().__init__(message)
        self.path = path


def _checked(name: str, content: dict[str, Any]) -> Scenario:
    _known(content, (), REQUIRED, OPTIONAL)
    if not isinstance(content["title"], str):
        raise _WrongKeyError(("title",), f"title is {content['title']!r}, must be a text")
    if content["reference"] not in list(REFERENCES):
        raise _WrongKeyError(
            ("reference",), f"reference {content['reference']!r} is not one of {', '.join(REFERENCES)}"
        )
    return Scenario(
        name=name,
        title=content["title"],
        reference=content["reference"],
        duration_s=_duration_s(content["duration_s"]),
        load=_load(content.get("load", [])),
        limits=_figures(content, "limits"),
        paper=_figures(content, "paper"),
        timing=_timing_limits(content.get("timing", {})),
        machine=_machine(content.get("machine", {})),
        faults=_faults(content.get("fault", []), content["duration_s"]),
    )


def _known(
    table: dict[str, Any], path: KeyPath, required: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Make sure that a table has the keys it needs, and no others."""
    within = f" in {_dotted(path)}" if path else ""
    allowed = ", ".join([*required, *optional])
    for key in table:
        if key not in (*required, *optional):
            raise _WrongKeyError((*path, key), f"unknown key {key!r}{within}; allowed are {allowed}")
    for key in required:
        if key not in table:
            raise _WrongKeyError(path, f"missing key {key!r}{within}; needed are {', '.join(required)}")


def _dotted(path: KeyPath) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).lstrip(".")


def _table(value: Any, path: KeyPath, of_what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _WrongKeyError(path, f"{_dotted(path)} is {value!r}, must be a table {of_what}")
    return value


def _duration_s(value: Any) -> float:
    if not _is_number(value) or not PERIOD_S <= value <= LONGEST_S:
        raise _WrongKeyError(
            ("duration_s",), f"duration_s is {value!r}, must be from {PERIOD_S} to {LONGEST_S:g} s"
        )
    return float(value)


def _load(steps: Any) -> tuple[tuple[float, float], ...]:
    if not isinstance(steps, list) or not all(_is_load_step(step) for step in steps):
        raise _WrongKeyError(
            ("load",), f"load must be a list of [time_s, force_n], from 0 s on and within {MAX_LOAD_N:g} N"
        )
    return tuple((float(time_s), float(force_n)) for time_s, force_n in steps)


def _figures(content: dict[str, Any], key: str) -> dict[str, dict[str, float]]:
    """Return `limits` or `paper`: figures by controller."""
    by_controller = _table(content.get(key, {}), (key,), f"by controller: {', '.join(CONTROLLERS)}")
    for controller, figures in by_controller.items():
        path = key, controller
        if controller not in CONTROLLERS:
            raise _WrongKeyError(path, f"{_dotted(path)} must be one of {', '.join(CONTROLLERS)}")
        _known(_table(figures, path, "with rms_mm and max_mm"), path, FIGURES)
        for figure, value in figures.items():
            if not _is_number(value):
                raise _WrongKeyError(
                    (*path, figure), f"{_dotted((*path, figure))} is {value!r}, must be a number"
                )
    return by_controller


def _timing_limits(value: Any) -> TimingLimits:
    names = [limit.name for limit in fields(TimingLimits)]
    table = _table(value, ("timing",), f"of limits: {', '.join(names)}")
    _known(table, ("timing",), (), names)
    for key, limit in table.items():
        counted = not key.endswith("_us")
        if not _is_number(limit) or limit < 0 or (counted and not isinstance(limit, int)):
            kind = "whole number" if counted else "number of µs"
            raise _WrongKeyError(("timing", key), f"timing.{key} is {limit!r}, must be a {kind} from 0 on")
    return TimingLimits(**table)


def _machine(value: Any) -> Machine:
    table = _table(value, ("machine",), "of what differs from the nominal one")
    machine = Machine()
    for key, of_key in table.items():
        try:
            machine = machine.with_changes({key: of_key})
        except ParameterError as error:
            raise _WrongKeyError(("machine", key), str(error)) from error
    return machine


def _faults(value: Any, duration_s: float) -> tuple[Fault, ...]:
    if not isinstance(value, list):
        raise _WrongKeyError(("fault",), "fault is no list: write each as a table [[fault]]")
    faults = tuple(_fault(table, ("fault", number)) for number, table in enumerate(value))
    for number, fault in enumerate(faults):
        if complaint := too_late(fault, duration_s):
            raise _WrongKeyError(("fault", number, "at_s"), complaint)
    return faults


def too_late(fault: Fault, duration_s: float) -> str:
    """Return what to say of a fault that would come after the end; nothing if it comes before."""
    if fault.at_s < duration_s:
        return ""
    return f"{fault.kind}: at_s is {fault.at_s}, must be below duration_s, {duration_s:g} s"


def _fault(value: Any, path: KeyPath) -> Fault:
    table = _table(value, path, "[[fault]]")
    try:
        return fault_of_table(table)
    except FaultError as error:
        raise _WrongKeyError((*path, error.key) if error.key in table else path, str(error)) from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_load_step(step: Any) -> bool:
    return (
        isinstance(step, list)
        and len(step) == 2
        and all(_is_number(value) for value in step)
        and step[0] >= 0
        and abs(step[1]) <= MAX_LOAD_N
    )
