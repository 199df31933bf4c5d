"""Integer codecs of single messages, generated once as straight-line code."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np

from dbc.e2e import Checker, Protector, profile2_crc, receiver_configuration
from dbc.frame import Frame
from dbc.profile2 import MAX_COUNTER

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal of the contract, for tools that work in physical units.

    The physical value is ``raw * factor + offset`` in `unit`; `minimum` and `maximum` are physical,
    None if the file sets no range. `page` is the value of the multiplexer, in the first byte, that selects
    the signal; None for one that is always there.
    """

    name: str
    start: int
    length: int
    signed: bool
    factor: float
    offset: float
    unit: str
    minimum: float | None
    maximum: float | None
    choices: Mapping[int, str]
    page: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MessageCodec(Generic[P, T]):
    """One message of the contract.

    Attributes
    ----------
    name : str
        Name in the DBC file.
    can_id : int
        Identifier, with `dbc.frame.EFF_FLAG` for a 29-bit one.
    dlc : int
        Payload length in bytes.
    cycle_time_ns : int
        Send period; 0 for a message sent on events only.
    data_ids : tuple of int or None
        The 16 DataIDs of E2E profile 2; None for an unprotected message.
    bench_channel : bool
        Whether the message is out of band: no bus load, no response-time analysis.
    signals : mapping of str to Signal
        All signals by their DBC names, in the order of their start bits.
    fields : sequence of FieldBits
        Where the layout's fields lie, in the layout's order.
    pack : callable
        Raw integers (plain int, one per field of the layout) to the payload as an unsigned integer, byte 0 in
        the low eight bits. E2E CRC and counter are left 0. Raises OverflowError for a value that does not fit
        its signal and TypeError for a numpy scalar, whose shifts would silently lose bits.
    unpack : callable
        Payload to the layout's named tuple of raw integers. E2E CRC and counter are not looked at.
    """

    name: str
    can_id: int
    dlc: int
    cycle_time_ns: int
    data_ids: tuple[int, ...] | None
    bench_channel: bool
    signals: Mapping[str, Signal]
    fields: Sequence["FieldBits"]
    pack: Callable[P, int]
    unpack: Callable[[int], T]

    def frame(self, data: int) -> Frame:
        """Return the frame that carries a payload."""
        return tuple.__new__(Frame, (self.can_id, self.dlc, data))

    def protector(self) -> Protector:
        """Return a sender's E2E state for this (protected) message."""
        return Protector(self._protected_ids(), self.dlc)

    def checker(self) -> Checker:
        """Return a receiver's E2E state for this (protected) message."""
        return Checker(self._protected_ids(), self.dlc)

    def with_crc(self, data: int) -> int:
        """Return a payload of this (protected) message with the CRC that belongs to it and its counter."""
        data_id = self._protected_ids()[data >> 8 & MAX_COUNTER]
        return data & ~0xFF | int(profile2_crc(data, self.dlc, data_id))

    def receiver_configuration(self) -> np.ndarray:
        """Return what `dbc.e2e.profile2_check` needs to know of this (protected) message."""
        return receiver_configuration(self._protected_ids(), self.dlc)

    def protected_layout(self) -> np.ndarray:
        """Return what compiled code needs to send or receive this (protected) message.

        Returns
        -------
        ndarray of int64, shape (dbc.profile2.CONFIGURATION_SIZE + fields,)
            The E2E configuration, then the start bit of each field.
        """
        return np.array([*self.receiver_configuration(), *(field.start for field in self.fields)], np.int64)

    def _protected_ids(self) -> tuple[int, ...]:
        if self.data_ids is None:
            raise ValueError(f"message {self.name} is not E2E protected")
        return self.data_ids


def signal_name(field: str) -> str:
    """Return the DBC's name of a layout's field: `target_velocity` is `TargetVelocity`."""
    return "".join(part.capitalize() for part in field.split("_"))


@dataclass(frozen=True, slots=True)
class FieldBits:
    """Where a field of a layout lies in the payload."""

    name: str
    start: int
    length: int
    signed: bool

    @property
    def mask(self) -> int:
        """All ones in the field's length."""
        return (1 << self.length) - 1

    @property
    def minimum(self) -> int:
        """Smallest raw value."""
        return -(1 << self.length - 1) if self.signed else 0


def generate_pack(layout_name: str, fields: Sequence[FieldBits]) -> Callable[..., int]:
    """Generate ``pack(*raw values) -> payload`` for a layout."""

    def refuse(*values: Any) -> Exception:
        for field, value in zip(fields, values, strict=True):
            if not isinstance(value, int):
                return TypeError(f"{layout_name}: {field.name} is a {type(value).__name__}, pass an int")
            if not field.minimum <= value <= field.minimum + field.mask:
                kind = "signed" if field.signed else "unsigned"
                return OverflowError(
                    f"{layout_name}: {field.name} = {value} exceeds {field.length} bits {kind}"
                )
        raise AssertionError("unreachable: some value was out of range")

    names = ", ".join(field.name for field in fields)
    excess = " | ".join(f"({field.name} - {field.minimum}) >> {field.length}" for field in fields)
    payload = " | ".join(f"({field.name} & {field.mask}) << {field.start}" for field in fields)
    source = (
        f"def pack({names}):\n"
        f"    payload = {payload}\n"
        f"    if {excess} or payload.__class__ is not int:\n"
        f"        raise refuse({names})\n"
        f"    return payload\n"
    )
    return _define("pack", source, refuse=refuse)


def generate_unpack(layout: type, fields: Sequence[FieldBits]) -> Callable[[int], Any]:
    """Generate ``unpack(payload) -> layout`` for a named tuple."""
    values = "".join(_extraction(field) + ", " for field in fields)
    source = f"def unpack(data):\n    return new(layout, ({values}))\n"
    return _define("unpack", source, new=tuple.__new__, layout=layout)


def _extraction(field: FieldBits) -> str:
    raw = f"(data >> {field.start} & {field.mask})"
    return f"({raw} ^ {-field.minimum}) - {-field.minimum}" if field.signed else raw


def _define(name: str, source: str, **namespace: Any) -> Callable[..., Any]:
    exec(source, namespace)
    function: Callable[..., Any] = namespace[name]
    return function
