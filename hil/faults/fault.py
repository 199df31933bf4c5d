"""What a fault is: a kind, parameters with units and bounds, and a time."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import partial
from numbers import Real
from typing import Any, ClassVar, Protocol

from dbc.contract import Contract
from hil.bus.wire import Port, Wire

LONGEST_S = 3600.0


def whole_ns(seconds: float) -> int:
    """Return a time in whole ns."""
    return round(seconds * 1e9)


class FaultError(ValueError):
    """A fault that does not exist or makes no sense; the message says what is allowed.

    Attributes
    ----------
    key : str
        The parameter concerned; empty if none is.
    """

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


def text_of(table: Mapping[str, Any]) -> str:
    """Return a fault's `Fault.table` as a command line takes it."""
    parameters = (f"{key}={value}" for key, value in table.items() if key != "kind")
    return ",".join([table["kind"], *parameters])


def number(low: float, high: float, unit: str, default: Any = MISSING) -> Any:
    """Return a field for a number within closed bounds, in a unit."""
    return field(default=default, metadata={"bounds": (low, high), "unit": unit})


def choice(*names: str, called: str = "", default: Any = MISSING) -> Any:
    """Return a field for one of some names; many may be `called` something in a list of faults."""
    return field(default=default, metadata={"choices": names, "called": called or ", ".join(names)})


def name(of_what: str) -> Any:
    """Return a field for a name that other parameters decide on."""
    return field(metadata={"name": of_what})


class Planner(Protocol):
    """What a supervisor is to faults."""

    @property
    def plan(self) -> Callable[..., None]:
        """Takes a period since power-on, and what is to change in it."""


@dataclass(frozen=True, slots=True)
class Stage:
    """What faults act on.

    Attributes
    ----------
    contract : Contract
        The DBC.
    supervisor : Planner
        Sends what goes over the bench channel.
    wire : Wire or None
        The simulated bus; None on a real one.
    ports : mapping of str to Port
        The places of nodes in virtual time, by name.
    at : callable
        Takes a bus time (ns) and an action, and has it done then, before the wire's own events.
    """

    contract: Contract
    supervisor: Planner
    wire: Wire | None
    ports: Mapping[str, Port]
    at: Callable[[int, Callable[[], None]], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """Something that goes wrong at a time.

    Each field's metadata holds ``unit`` and closed ``bounds``, or ``choices``.

    Parameters
    ----------
    at_s : float
        When, in s: from the scenario's start, or from now when it is injected into a run.

    Raises
    ------
    FaultError
        One line that names the parameter, its value and what is allowed.
    """

    kind: ClassVar[str]
    needs_virtual_time: ClassVar[bool] = True

    at_s: float = number(0.0, LONGEST_S, "s", default=0.0)

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, _checked(self.kind, item, getattr(self, item.name)))

    @abstractmethod
    def inject(self, stage: Stage, origin_ns: int) -> None:
        """Have it happen `at_s` after bus time `origin_ns`.

        Raises
        ------
        FaultError
            If it cannot be had there.
        """

    def begin_ns(self, origin_ns: int) -> int:
        """Return when it begins, ns, its time counting from `origin_ns`."""
        return origin_ns + whole_ns(self.at_s)

    @property
    def table(self) -> dict[str, Any]:
        """Kind, time and parameters as in a scenario file, without what is at its default."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        defaults = {item.name: item.default for item in fields(self) if item.name != "at_s"}
        return {"kind": self.kind} | {
            key: value for key, value in values.items() if defaults.get(key, MISSING) != value
        }

    @property
    def text(self) -> str:
        """The fault as a command line takes it."""
        return text_of(self.table)


@dataclass(frozen=True, slots=True, kw_only=True)
class WireFault(Fault):
    """One that is brought about on the simulated wire."""

    def inject(self, stage: Stage, origin_ns: int) -> None:
        """Have it begin `at_s` after bus time `origin_ns`."""
        self.check(stage)
        stage.at(self.begin_ns(origin_ns), partial(self.begin, stage))

    @property
    def concerned(self) -> str:
        """The node that has to be there; nothing if none has."""
        return str(getattr(self, "node", ""))

    def check(self, stage: Stage) -> None:
        """Refuse what cannot be had there."""
        self.wire(stage)
        if self.concerned:
            self.port(stage, self.concerned)

    def wire(self, stage: Stage) -> Wire:
        """Return the simulated wire."""
        if stage.wire is None:
            raise FaultError(f"{self.kind} needs virtual time: use mode inprocess or lockstep")
        return stage.wire

    def port(self, stage: Stage, node: str) -> Port:
        """Return a node's place on the wire."""
        if node not in stage.ports:
            raise FaultError(f"{self.kind} needs the {node} in virtual time: inject it into a lock-step run")
        return stage.ports[node]

    @abstractmethod
    def begin(self, stage: Stage) -> None:
        """Do what has to be done when it begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LastingWireFault(WireFault):
    """One that ends by itself.

    Parameters
    ----------
    duration_s : float
        How long it lasts, s; to the end of the run if not given.
    """

    duration_s: float = number(1e-6, math.inf, "s", default=math.inf)

    def inject(self, stage: Stage, origin_ns: int) -> None:
        """Have it begin `at_s` after bus time `origin_ns`, and end."""
        WireFault.inject(self, stage, origin_ns)
        if self.duration_s < math.inf:
            end_ns = self.begin_ns(origin_ns) + whole_ns(self.duration_s)
            stage.at(end_ns, partial(self.end, stage))

    @abstractmethod
    def end(self, stage: Stage) -> None:
        """Do what has to be done when it ends."""


def allowed(item: "Field[Any]") -> str:
    """Return what a parameter may be, in words."""
    if of_what := item.metadata.get("name"):
        return f"the name of {of_what}"
    if choices := item.metadata.get("choices"):
        return f"one of {', '.join(choices)}"
    kind = "a whole number" if item.type is int else "a number"
    return f"{kind} from {_range(item)}"


def described(item: "Field[Any]") -> str:
    """Return a parameter for a list of faults: name, values, and the default in brackets."""
    values = _range(item) if "bounds" in item.metadata else item.metadata.get("called", allowed(item))
    default = {MISSING: "", math.inf: " (to the end)"}.get(item.default, f" ({item.default})")
    return f"`{item.name}` {values}{default}"


def _range(item: "Field[Any]") -> str:
    (low, high), unit = item.metadata["bounds"], item.metadata["unit"]
    low_text, high_text = (str(bound) if item.type is int else f"{bound:g}" for bound in (low, high))
    upper = "" if high == math.inf else f" to {high_text}"
    return f"{low_text}{upper} {unit}".rstrip() + (" on" if high == math.inf else "")


def _checked(kind: str, item: "Field[Any]", value: Any) -> Any:
    if "name" in item.metadata:
        good = isinstance(value, str)
    elif choices := item.metadata.get("choices"):
        good = isinstance(value, str) and value in choices
    else:
        low, high = item.metadata["bounds"]
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        good = is_number and low <= value <= high and (item.type is not int or value == int(value))
    if not good:
        raise FaultError(f"{kind}: {item.name} is {value!r}, must be {allowed(item)}", item.name)
    return item.type(value) if callable(item.type) else value
