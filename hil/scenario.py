"""A scenario is data: reference, load profile, duration and the limits the run must meet."""

import math
import tomllib
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from dbc.node import PERIOD_NS
from hil.references import REFERENCES
from plant_sim.machine import Machine
from plant_sim.parameters import ParameterError

CONTROLLERS = ("p", "pi", "adrc", "pi_ff", "scheduled")
PERIOD_S = PERIOD_NS * 1e-9
MAX_LOAD_N = 1e6


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
        Length to play instead of the scenario's own, s; its limits and the paper's figures do not apply then.

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
    if duration_s is not None:
        content |= {"duration_s": duration_s, "limits": {}, "paper": {}, "timing": {}}
    return _checked(path.stem, content)


def _checked(name: str, content: dict[str, Any]) -> Scenario:
    required = {"title", "reference", "duration_s"}
    optional = {"load", "limits", "paper", "timing", "machine"}
    if missing := sorted(required - set(content)):
        raise ScenarioError(f"{name}: missing key {missing[0]!r}")
    if unknown := sorted(set(content) - required - optional):
        allowed = ", ".join(sorted(required | optional))
        raise ScenarioError(f"{name}: unknown key {unknown[0]!r}; allowed are {allowed}")
    if not isinstance(content["title"], str):
        raise ScenarioError(f"{name}: title is {content['title']!r}, must be a text")
    if content["reference"] not in list(REFERENCES):
        raise ScenarioError(
            f"{name}: reference {content['reference']!r} is not one of {', '.join(REFERENCES)}"
        )
    duration_s = content["duration_s"]
    if not _is_number(duration_s) or not PERIOD_S <= duration_s <= 3600:
        raise ScenarioError(f"{name}: duration_s is {duration_s!r}, must be from {PERIOD_S} to 3600 s")
    load = content.get("load", [])
    if not isinstance(load, list) or not all(_is_load_step(step) for step in load):
        raise ScenarioError(
            f"{name}: load must be a list of [time_s, force_n], from 0 s on and within {MAX_LOAD_N:g} N"
        )
    for key in ("limits", "paper"):
        if not isinstance(content.get(key, {}), dict):
            raise ScenarioError(f"{name}: {key} must be a table by controller")
        for controller, figures in content.get(key, {}).items():
            if controller not in CONTROLLERS or not _are_figures(figures):
                raise ScenarioError(
                    f"{name}: {key}.{controller} must be one of {', '.join(CONTROLLERS)} "
                    "with rms_mm and max_mm"
                )
    return Scenario(
        name=name,
        title=content["title"],
        reference=content["reference"],
        duration_s=float(duration_s),
        load=tuple((float(time_s), float(force_n)) for time_s, force_n in load),
        limits=content.get("limits", {}),
        paper=content.get("paper", {}),
        timing=_timing_limits(name, content.get("timing", {})),
        machine=_machine(name, content.get("machine", {})),
    )


def _timing_limits(name: str, table: Any) -> TimingLimits:
    allowed = {limit.name for limit in fields(TimingLimits)}
    hint = f"allowed are {', '.join(sorted(allowed))}"
    if not isinstance(table, dict):
        raise ScenarioError(f"{name}: timing must be a table of limits; {hint}")
    if unknown := sorted(set(table) - allowed):
        raise ScenarioError(f"{name}: unknown key {unknown[0]!r} in timing; {hint}")
    for key, limit in table.items():
        counted = not key.endswith("_us")
        if not _is_number(limit) or limit < 0 or (counted and not isinstance(limit, int)):
            kind = "whole number" if counted else "number of µs"
            raise ScenarioError(f"{name}: timing.{key} is {limit!r}, must be a {kind} from 0 on; {hint}")
    return TimingLimits(**table)


def _machine(name: str, table: Any) -> Machine:
    if not isinstance(table, dict):
        raise ScenarioError(f"{name}: machine must be a table")
    try:
        return Machine.from_table(table)
    except ParameterError as error:
        raise ScenarioError(f"{name}: {error}") from error


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


def _are_figures(figures: Any) -> bool:
    return (
        isinstance(figures, dict)
        and set(figures) == {"rms_mm", "max_mm"}
        and all(_is_number(value) for value in figures.values())
    )
