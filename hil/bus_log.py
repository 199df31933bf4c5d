"""Bus logs in the formats of the CAN world, read and written by python-can by the file's suffix."""

import gzip
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import can
import numpy as np
from can.io.blf import FILE_HEADER_STRUCT
from can.io.generic import TextIOMessageReader
from can.io.logger import MESSAGE_WRITERS
from can.io.player import MESSAGE_READERS

from dbc.frame import ERR_FLAG, FD_FLAG, Frame
from hil.bus.messages import to_frame, to_message
from hil.bus.mf4_on_demand import load_mf4
from hil.bus.wire_time import PAYLOAD_SHIFT
from hil.run.options import BenchError

RESOLUTION_NS = 1000
"""To what the times of a log are rounded, ns: what each of the formats keeps."""

_NO_ROOM_FOR = {".trc": ERR_FLAG | FD_FLAG, ".csv": FD_FLAG, ".db": FD_FLAG}
"""Which frames python-can's writer of a format leaves out, or writes as what they are not."""

_BLF_FILE_SIZE = 10
"""Where in the header of a .blf."""

_EVERY_CHANNEL = ""
"""Of error frames, as candump's reader does not tell theirs."""

MF4_EXTRA = ".mf4 needs asammdf: pip install '.[mf4]' in the project's folder"


@dataclass(frozen=True, slots=True, eq=False)
class BusLog:
    """What a log holds.

    Attributes
    ----------
    traffic : ndarray of uint64, shape (frames, 4)
        As in `hil.run.options.Recording`: time (ns, whole µs), id, dlc, data, in order of time; error frames
        have `ERR_FLAG`. Times count from where those of the log do; `.asc` begins at the first frame.
    left_out : Counter of str
        Remote and CAN FD frames, by kind: no node takes them.
    damage : str
        Why the log must have held more than what could be read; empty where nothing shows it.
    """

    traffic: np.ndarray
    left_out: Counter[str] = field(default_factory=Counter)
    damage: str = ""


def check_log_format(suffix: str) -> None:
    """Make sure that bus logs can be written in a format.

    Raises
    ------
    BenchError
        If no writer knows the suffix, or a package that it needs is missing.
    """
    if suffix not in MESSAGE_WRITERS:
        known = ", ".join(sorted(MESSAGE_WRITERS))
        raise BenchError(f"no bus log can be written as {suffix!r}: choose one of {known}")
    _check_package(suffix)


def write_bus_log(path: Path, traffic: np.ndarray, payloads: np.ndarray | None = None) -> int:
    """Write frames, stamped with bus time, in the format of the file's suffix.

    Parameters
    ----------
    path : Path
        The file.
    traffic, payloads : ndarray
        As in `hil.run.options.Recording`; the payloads only matter if there are CAN FD frames.

    Returns
    -------
    int
        Frames left out, because the format has no room for them.
    """
    unfit = (traffic[:, 1] & np.uint64(_NO_ROOM_FOR.get(_format_of(path), 0))) != 0
    with can.Logger(path) as writer:
        for time_ns, can_id, dlc, data in traffic[~unfit].tolist():
            if can_id & FD_FLAG and payloads is not None:
                data = int.from_bytes(payloads[data >> PAYLOAD_SHIFT].tobytes(), "little")
            writer.on_message_received(to_message(time_ns, Frame(can_id, dlc, data), channel="can0"))
    return int(unfit.sum())


def read_bus_log(path: Path, channel: str | None = None) -> BusLog:
    """Read a log, as far as it is intact, in the format of its suffix, which may be followed by ``.gz``.

    Parameters
    ----------
    path : Path
        The file.
    channel : str, optional
        Which of the log's channels; needed if there are several.

    Raises
    ------
    BenchError
        If the file cannot be read, holds no frame, or more than one channel.
    """
    suffix = _format_of(path)
    if suffix not in MESSAGE_READERS:
        known = ", ".join(sorted(MESSAGE_READERS))
        raise BenchError(f"{path}: no bus log can be read from {suffix!r}: choose one of {known}")
    _check_package(suffix)
    rows: list[tuple[str, float, int, int, int]] = []
    left_out: Counter[str] = Counter()
    damage = ""
    try:
        with can.LogReader(path) as reader:
            for message in reader:
                if message.is_fd or message.is_remote_frame:
                    left_out["CAN FD" if message.is_fd else "remote"] += 1
                else:
                    rows.append((_channel_of(message), message.timestamp, *_frame_in_log(message)))
    except OSError as error:
        raise BenchError(f"{path}: cannot be read ({error.strerror or error}): check the path") from error
    except Exception as error:  # whatever a reader makes of what is not its format
        damage = " ".join(str(error).split()) or type(error).__name__
        if not rows:
            raise BenchError(f"{path}: not a {suffix} bus log, or a damaged one ({damage})") from error
    else:
        damage = _sign_of_a_cut(path, suffix)
        if damage and issubclass(MESSAGE_READERS[suffix], TextIOMessageReader):
            del rows[-1:]  # of the line that was cut
    names = {row[0] for row in rows} - {_EVERY_CHANNEL}
    if not names:
        raise BenchError(f"{path}: there is no data frame in it")
    if channel is None and len(names) == 1:
        (channel,) = names
    if channel not in names:
        asked = "more than one channel is" if channel is None else f"no channel {channel!r} is"
        raise BenchError(f"{path}: {asked} in it: choose one of {', '.join(sorted(names))} by --channel")
    chosen = [row[1:] for row in rows if row[0] in (channel, _EVERY_CHANNEL)]
    return BusLog(_traffic(chosen), left_out, damage)


def holds_all_frames(path: Path) -> bool:
    """Return whether the format of a log has room for every frame of a run."""
    return _format_of(path) not in _NO_ROOM_FOR


def _sign_of_a_cut(path: Path, suffix: str) -> str:
    """Return what shows that a log that could be read was not written to its end; empty if nothing does."""
    opened = gzip.open if path.suffix.lower() == ".gz" else open
    with opened(path, "rb") as file:
        content = file.read()
    if suffix == ".blf":
        size = FILE_HEADER_STRUCT.unpack_from(content)[_BLF_FILE_SIZE]
        return "" if size == len(content) else f"{len(content)} bytes, {size} in its header"
    if not issubclass(MESSAGE_READERS[suffix], TextIOMessageReader):
        return ""
    if not content.endswith(b"\n"):
        return "its last line is not complete"
    if suffix == ".asc":
        content = content.lower()
        if content.rfind(b"begin triggerblock") > content.rfind(b"end triggerblock"):
            return "no End TriggerBlock"
    return ""


def _format_of(path: Path) -> str:
    return next((part for part in reversed(path.suffixes) if part != ".gz"), "").lower()


def _check_package(suffix: str) -> None:
    if suffix == ".mf4" and not load_mf4():
        raise BenchError(MF4_EXTRA)


def _frame_in_log(message: can.Message) -> Frame:
    """Return a frame as `Wire.traffic` has it, error frames included."""
    if not message.is_error_frame:
        return to_frame(message)
    return Frame(message.arbitration_id | ERR_FLAG, message.dlc, int.from_bytes(message.data, "little"))


def _channel_of(message: can.Message) -> str:
    return _EVERY_CHANNEL if message.is_error_frame else str(message.channel)


def _traffic(rows: list[tuple[float, int, int, int]]) -> np.ndarray:
    times_s = np.array([time_s for time_s, *_ in rows])
    times_ns = np.round(times_s * (1e9 / RESOLUTION_NS)).astype(np.int64) * RESOLUTION_NS
    traffic = np.empty((len(rows), 4), np.uint64)
    traffic[:, 0] = times_ns.astype(np.uint64)
    traffic[:, 1:] = np.array([row[1:] for row in rows], np.uint64)
    return traffic[np.argsort(times_ns, kind="stable")]
