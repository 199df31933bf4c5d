"""The kinds of faults there are, and faults from tables and texts."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, NamedTuple

from hil.faults import bus, controller, machine, message
from hil.faults.fault import Fault, FaultError, allowed, described

GROUPS: dict[str, tuple[type[Fault], ...]] = {
    "bus": (
        bus.Drop,
        bus.Delay,
        message.Duplicate,
        bus.Corrupt,
        bus.Repeat,
        bus.Destroy,
        bus.BitErrors,
        bus.Babble,
        bus.BusOff,
        bus.CutOff,
        bus.PowerOff,
    ),
    "message": (
        message.WrongCrc,
        message.FrozenCounter,
        message.JumpingCounter,
        message.FrozenSignal,
        message.SignalOffset,
        message.SignalRamp,
        message.RandomSignal,
    ),
    "sensor": (
        machine.SensorStuck,
        machine.SensorBias,
        machine.SensorDrift,
        machine.SensorNoise,
        machine.SensorDropout,
        machine.SensorStatus,
    ),
    "machine": (
        machine.PrechargeLoss,
        machine.Leak,
        machine.ReliefStuckOpen,
        machine.EfficiencyLoss,
        machine.EntrainedAir,
        machine.MotorSpeedLoss,
        machine.MotorAccelerationLoss,
        machine.LoadStep,
        machine.LoadImpulse,
    ),
    "node": (controller.Reset, controller.ClockDrift, controller.LatePeriod, controller.LongExecution),
}
"""Faults by what they act on."""

KINDS = {kind.kind: kind for group in GROUPS.values() for kind in group}


class Row(NamedTuple):
    """A line of a list of faults.

    Attributes
    ----------
    kind, group : str
        Name, and what it acts on.
    summary : str
        What happens.
    parameters : tuple of str
        Name, values, and in brackets the default of each.
    real_time : bool
        Whether it can be had in real time as well.
    """

    kind: str
    group: str
    summary: str
    parameters: tuple[str, ...]
    real_time: bool


def rows() -> list[Row]:
    """Return a row for each kind; `at_s`, which all have, is left out."""
    return [
        Row(
            kind.kind,
            group,
            _summary(kind),
            _parameters(kind),
            not kind.needs_virtual_time,
        )
        for group, kinds in GROUPS.items()
        for kind in kinds
    ]


def fault_of(kind: str, parameters: Mapping[str, Any]) -> Fault:
    """Return a fault of a kind.

    Raises
    ------
    FaultError
        If there is no such kind or parameter, one is missing, or a value is not allowed.
    """
    if kind not in KINDS:
        raise FaultError(f"there is no fault {kind!r}: choose one of {', '.join(KINDS)}", "kind")
    known = {item.name: item for item in fields(KINDS[kind])}
    for key in parameters:
        if key not in known:
            raise FaultError(f"{kind}: there is no {key!r}, only {', '.join(known)}", key)
    for key, item in known.items():
        if item.default is MISSING and key not in parameters:
            raise FaultError(f"{kind}: {key} is missing, must be {allowed(item)}")
    return KINDS[kind](**parameters)


def fault_of_table(table: Mapping[str, Any]) -> Fault:
    """Return the fault that a table as in a scenario file describes, with its kind under ``kind``.

    Raises
    ------
    FaultError
        If the kind is missing, or as for `fault_of`.
    """
    if "kind" not in table:
        raise FaultError(f"missing key 'kind': it is one of {', '.join(KINDS)}")
    return fault_of(table["kind"], {key: value for key, value in table.items() if key != "kind"})


def fault_of_text(text: str) -> Fault:
    """Return the fault that a text like ``sensor_bias,at_s=1,bias_m=0.001`` describes.

    Raises
    ------
    FaultError
        If the text is of another form, or as for `fault_of`.
    """
    kind, *parts = (part.strip() for part in text.split(","))
    parameters: dict[str, Any] = {}
    for part in parts:
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or key in parameters:
            raise FaultError(f"{text!r} is not of the form KIND,KEY=VALUE,KEY=VALUE, each key once")
        parameters[key] = _value(value)
    return fault_of(kind, parameters)


def _summary(kind: type[Fault]) -> str:
    return (kind.__doc__ or "").partition("\n")[0]


def _parameters(kind: type[Fault]) -> tuple[str, ...]:
    return tuple(described(item) for item in fields(kind) if item.name != "at_s")


def _value(text: str) -> int | float | str:
    """Return the number a text says; the text itself if it says none."""
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text
