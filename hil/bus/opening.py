"""Opening a bus: what the command line leaves open comes from python-can's own configuration.

That is, in this order, `can.rc`, the environment (CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE, CAN_CONFIG) and
files such as ~/.canrc: see python-can's `can.util.load_config`.
"""

import logging
from collections.abc import Iterator
from configparser import Error as ConfigFileError
from contextlib import contextmanager
from typing import Any, NamedTuple

import can

from hil.bus.socketcan import SteadySocketcanBus

_CHOOSE = "give -i and -c, e.g. -i socketcan -c vcan0, or write interface and channel to ~/.canrc"
_HINTS = {"socketcan": "`hil vcan status` says what is missing", "hilbus": "check -c"}
_HINT = "check -i, -c and the adapter's driver (docs/real-hardware.md)"


class BusSettings(NamedTuple):
    """Which bus to open.

    Attributes
    ----------
    interface, channel : str
        python-can's.
    bit_rate : int or None
        Bit/s; None leaves it to the adapter: SocketCAN's was set with the interface, others have a default.
    """

    interface: str
    channel: str
    bit_rate: int | None


def bus_settings(interface: str | None, channel: str | None, bit_rate: int | None) -> BusSettings:
    """Return which bus is meant; None is looked up in python-can's configuration.

    Raises
    ------
    can.CanInitializationError
        If that leaves interface or channel open, or the configuration cannot be read.
    """
    configuration = _configuration(interface, channel, bit_rate)
    return BusSettings(
        configuration["interface"], channel or str(configuration["channel"]), configuration.get("bitrate")
    )


def open_bus(
    interface: str | None, channel: str | None, bit_rate: int | None, fd: bool = False
) -> can.BusABC:
    """Open a bus; None, and all that only this adapter has, is looked up in python-can's configuration.

    With `fd`, CAN FD frames are heard as well, whatever the configuration says.

    Raises
    ------
    can.CanInitializationError
        If it cannot be opened, whatever its driver raises; one line that says what to do.
    """
    configuration = _configuration(interface, channel, bit_rate)
    if fd:
        configuration["fd"] = True
    name, where = configuration["interface"], configuration["channel"]
    try:
        with _raised_not_logged():
            if name == "socketcan":
                del configuration["interface"]
                return SteadySocketcanBus(**configuration)
            return can.Bus(ignore_config=True, **configuration)
    except Exception as error:  # drivers raise whatever they like when a library or a device is missing
        what = f"cannot open {name} channel {where!r} ({_one_line(error)})"
        raise can.CanInitializationError(f"{what}: {_HINTS.get(name, _HINT)}") from error


def _configuration(interface: str | None, channel: str | None, bit_rate: int | None) -> dict[str, Any]:
    given = {"interface": interface, "channel": channel, "bitrate": bit_rate}
    try:
        configuration: dict[str, Any] = dict(
            can.util.load_config(config={key: value for key, value in given.items() if value is not None})
        )
    except (can.CanError, ConfigFileError, ValueError, TypeError, OSError) as error:
        reason = _one_line(error).replace('Unknown interface type "None"', "No interface is configured")
        raise can.CanInitializationError(f"{reason}: {_CHOOSE}") from error
    if configuration["channel"] is None:
        raise can.CanInitializationError(f"no channel for {configuration['interface']}: {_CHOOSE}")
    return configuration


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def _raised_not_logged() -> Iterator[None]:
    """Keep python-can from printing what it raises as well, unless logging has been set up."""
    handler = logging.NullHandler()
    logger = logging.getLogger("can")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
