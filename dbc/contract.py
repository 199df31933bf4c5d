"""The contract on the bus, read from a DBC file once at start-up."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Self, TypeVar, get_type_hints

from dbc import messages
from dbc.codec import FieldBits, MessageCodec, Signal, generate_pack, generate_unpack, signal_name
from dbc.frame import EFF_FLAG
from dbc.messages import Raw

if TYPE_CHECKING:
    from cantools.database.can import Database
    from cantools.database.can import Message as DbcMessage
    from cantools.database.can import Signal as DbcSignal

P = ParamSpec("P")
T = TypeVar("T")

PACKAGED_DBC = Path(__file__).with_name("ddh.dbc")
NS_PER_MS = 1_000_000
MAX_CLASSIC_DLC = 8
E2E_SIGNALS = (("Crc", 0, Raw(8)), ("Counter", 8, Raw(4)))
"""Name, start bit and encoding that profile 2 prescribes."""


class ContractError(Exception):
    """Raised when a DBC file cannot be read or lacks what the code relies on; one line."""


class Contract:
    """All messages of the contract, each with its integer codec.

    Attributes
    ----------
    path : pathlib.Path
        The DBC file.
    bitrate : int
        Nominal bit rate, bit/s.
    messages : tuple of MessageCodec
        In order of priority: 11-bit identifiers first, each kind ascending.
    bench_channel_ids : frozenset of int
        Identifiers of the messages on the bench channel: out of band.
    """

    def __init__(self, path: Path, database: "Database") -> None:
        reader = _Reader(path, database)
        self.path = path
        self.bitrate = reader.bitrate()
        self.drive_command = reader.codec(messages.DriveCommand, protected=True)
        self.position_feedback = reader.codec(messages.PositionFeedback, protected=True)
        self.position_setpoint = reader.codec(messages.PositionSetpoint, protected=True)
        self.controller_command = reader.codec(messages.ControllerCommand, protected=True)
        self.drive_status = reader.codec(messages.DriveStatus, protected=True)
        self.pressure_feedback = reader.codec(messages.PressureFeedback)
        self.controller_status = reader.codec(messages.ControllerStatus)
        self.observer_state = reader.codec(messages.ObserverState)
        self.bench_control = reader.codec(messages.BenchControl)
        self.bench_load = reader.codec(messages.BenchLoad)
        codecs = [value for value in vars(self).values() if isinstance(value, MessageCodec)]
        codecs.sort(key=lambda codec: codec.can_id)
        self.messages: tuple[MessageCodec[..., Any], ...] = tuple(codecs)
        self.bench_channel_ids = frozenset(codec.can_id for codec in codecs if codec.bench_channel)

    def message(self, name: str) -> MessageCodec[..., Any]:
        """Return a message by its name in the DBC.

        Raises
        ------
        ValueError
            If there is none of that name.
        """
        for message in self.messages:
            if message.name == name:
                return message
        known = ", ".join(message.name for message in self.messages)
        raise ValueError(f"there is no message {name!r}: choose one of {known}")

    @classmethod
    def load(cls, path: Path | None = None) -> Self:
        """Parse a DBC file and check it against `dbc.messages`.

        Parameters
        ----------
        path : pathlib.Path, optional
            The file; the packaged ``ddh.dbc`` if omitted.

        Raises
        ------
        ContractError
            The file is unreadable, not a valid DBC, or lacks something the code relies on.
        """
        path = path or PACKAGED_DBC
        return cls(path, read_database(path))


def read_database(path: Path) -> "Database":
    """Parse a DBC file, ours or any other.

    Raises
    ------
    ContractError
        The file is unreadable or not a valid DBC.
    """
    # 0.2 s, paid only where a file is loaded
    from cantools.database import Database, load_file
    from cantools.database.errors import Error

    try:
        database = load_file(path, database_format="dbc")
    except (OSError, UnicodeDecodeError) as error:
        raise ContractError(f"{path}: cannot be read ({error}): check the path") from error
    except Error as error:
        reason = " ".join(str(error).split())
        remedy = "correct it or use the packaged ddh.dbc"
        raise ContractError(f"{path}: not a valid DBC ({reason}): {remedy}") from error
    assert isinstance(database, Database)
    return database


class _Reader:
    """Builds codecs from a database and says what it lacks."""

    def __init__(self, path: Path, database: "Database") -> None:
        self._path = path
        self._database = database

    def bitrate(self) -> int:
        attribute = self._database.dbc.attributes.get("Baudrate") if self._database.dbc else None
        if attribute is None:
            raise self._missing("attribute Baudrate")
        return int(attribute.value)

    def codec(self, layout: Callable[P, T], *, protected: bool = False) -> MessageCodec[P, T]:
        """Build the codec of the message that a named tuple of `dbc.messages` describes."""
        assert isinstance(layout, type)
        name = layout.__name__
        message = next((message for message in self._database.messages if message.name == name), None)
        if message is None:
            raise self._missing(f"message {name}")
        if message.length > MAX_CLASSIC_DLC:
            raise self._wrong(f"message {name}", f"must have at most {MAX_CLASSIC_DLC} bytes")
        bench_channel = bool(_attribute(message, "BenchChannel", default=0))
        if not bench_channel and not message.cycle_time:
            raise self._missing(f"message {name}: attribute GenMsgCycleTime")
        fields = [
            self._field_bits(message, field, hint.__metadata__)
            for field, hint in get_type_hints(layout, include_extras=True).items()
        ]
        return MessageCodec(
            name=name,
            can_id=message.frame_id | (EFF_FLAG if message.is_extended_frame else 0),
            dlc=message.length,
            cycle_time_ns=(message.cycle_time or 0) * NS_PER_MS,
            data_ids=self._data_ids(message) if protected else None,
            bench_channel=bench_channel,
            signals={signal.name: _physical(signal) for signal in message.signals},
            fields=fields,
            pack=generate_pack(name, fields),
            unpack=generate_unpack(layout, fields),
        )

    def _data_ids(self, message: "DbcMessage") -> tuple[int, ...]:
        for name, start, raw in E2E_SIGNALS:
            if self._signal(message, name, raw).start != start:
                raise self._wrong(
                    f"message {message.name}: signal {name}", f"must start at bit {start} (E2E)"
                )
        attribute = "E2EProfile2DataIdList"
        ids = _attribute(message, attribute, default="").split(",")
        if len(ids) != 16 or not all(i.strip().isdecimal() and int(i) <= 0xFF for i in ids):
            raise self._wrong(
                f"message {message.name}: attribute {attribute}", "must list 16 numbers of 0..255"
            )
        return tuple(int(i) for i in ids)

    def _field_bits(self, message: "DbcMessage", field: str, encodings: tuple[Raw, ...]) -> FieldBits:
        signals = [self._signal(message, raw.signal or signal_name(field), raw) for raw in encodings]
        first, *others = signals
        for other in others:
            if other.start != first.start:
                raise self._wrong(f"message {message.name}: signal {other.name}", f"must lie on {first.name}")
        return FieldBits(field, first.start, encodings[0].length, encodings[0].signed)

    def _signal(self, message: "DbcMessage", name: str, raw: Raw) -> "DbcSignal":
        """Return the signal of that name, which must be encoded as `raw` says."""
        what = f"message {message.name}: signal {name}"
        signal = next((signal for signal in message.signals if signal.name == name), None)
        if signal is None:
            raise self._missing(what)
        pages = None if raw.page is None else [raw.page]
        integer = (
            signal.length,
            signal.is_signed,
            signal.byte_order,
            signal.conversion.is_float,
            signal.offset,
        )
        if integer != (raw.length, raw.signed, "little_endian", False, 0):
            sign = "signed" if raw.signed else "unsigned"
            raise self._wrong(what, f"must be a little-endian {raw.length}-bit {sign} integer without offset")
        if not math.isclose(signal.scale, raw.factor, rel_tol=1e-9):
            raise self._wrong(what, f"must have factor {raw.factor!r}, not {signal.scale!r}")
        if signal.multiplexer_ids != pages:
            raise self._wrong(
                what, "must not be multiplexed" if pages is None else f"must be page m{raw.page}"
            )
        return signal

    def _missing(self, what: str) -> ContractError:
        return ContractError(f"{self._path}: {what} is missing: add it or use the packaged ddh.dbc")

    def _wrong(self, what: str, demand: str) -> ContractError:
        return ContractError(f"{self._path}: {what} {demand}: correct it or use the packaged ddh.dbc")


def _attribute(message: "DbcMessage", name: str, *, default: Any) -> Any:
    attribute = message.dbc.attributes.get(name) if message.dbc else None
    return default if attribute is None else attribute.value


def _physical(signal: "DbcSignal") -> Signal:
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        signed=signal.is_signed,
        factor=signal.scale,
        offset=signal.offset,
        unit=signal.unit or "",
        minimum=signal.minimum,
        maximum=signal.maximum,
        choices={raw: str(choice) for raw, choice in (signal.choices or {}).items()},
        page=signal.multiplexer_ids[0] if signal.multiplexer_ids else None,
    )
