"""SocketCAN: whether this machine has it, and a bus that outlives its interface being down."""

import errno
import os
import platform
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import can
from can.interfaces.socketcan import SocketcanBus

_DEVICES = Path("/sys/class/net")
_MODULES = Path("/lib/modules", platform.release())
_ARPHRD_CAN = 280
_IFF_UP = 1

_WITHOUT = "`hil run sine --mode realtime` (or `-i hilbus`) works without it, `make test-vcan` boots a guest"
_NOT_LINUX = (
    "SocketCAN needs Linux: use `hil run sine --mode inprocess`, or an adapter that python-can drives"
)
_NO_MODULE = f"this kernel has no SocketCAN: {_WITHOUT}"
_NOT_LOADED = "SocketCAN is not loaded: type `sudo modprobe -a can-raw vcan`"
_NOT_ALLOWED = f"CAN sockets are not permitted here, as in many containers: {_WITHOUT}"
_NO_INTERFACE = (
    "there is no CAN interface: type `sudo ip link add dev vcan0 type vcan && sudo ip link set up vcan0`"
)


@dataclass(frozen=True, slots=True)
class SocketcanStatus:
    """Whether SocketCAN can be used here.

    Attributes
    ----------
    usable : bool
        Whether a CAN interface is up and may be used.
    line : str
        What was found, and what to type next.
    """

    usable: bool
    line: str


def _open_raw_socket() -> None:
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()


def socketcan_status(
    system: str = sys.platform,
    open_raw_socket: Callable[[], None] = _open_raw_socket,
    devices: Path = _DEVICES,
    modules: Path = _MODULES,
) -> SocketcanStatus:
    """Find out whether SocketCAN can be used here; the arguments are where to look.

    Parameters
    ----------
    system : str
        As `sys.platform`.
    open_raw_socket : callable
        Opens and closes a CAN_RAW socket; raises OSError.
    devices : Path
        The kernel's network devices, a folder each.
    modules : Path
        The running kernel's modules.
    """
    if system != "linux":
        return SocketcanStatus(False, _NOT_LINUX)
    try:
        open_raw_socket()
    except OSError as error:
        if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
            there = any(modules.rglob("vcan.ko*"))
            return SocketcanStatus(False, _NOT_LOADED if there else _NO_MODULE)
        if error.errno in (errno.EPERM, errno.EACCES):
            return SocketcanStatus(False, f"{error.strerror}: {_NOT_ALLOWED}")
        return SocketcanStatus(False, f"no CAN socket can be opened ({error.strerror}): {_WITHOUT}")
    interfaces = dict(_can_interfaces(devices))
    up = [name for name, is_up in interfaces.items() if is_up]
    if up:
        command = f"hil run sine --mode realtime -i socketcan -c {up[0]}"
        return SocketcanStatus(True, f"SocketCAN is usable, up: {', '.join(up)}; type `{command}`")
    if not interfaces:
        return SocketcanStatus(False, _NO_INTERFACE)
    name = next(iter(interfaces))
    bit_rate = " type can bitrate 1000000" if (devices / name / "device").exists() else ""
    found = f"down: {', '.join(interfaces)}"
    return SocketcanStatus(
        False, f"no CAN interface is up, {found}; type `sudo ip link set {name} up{bit_rate}`"
    )


def _can_interfaces(devices: Path) -> Iterator[tuple[str, bool]]:
    """Yield name and whether it is up of each CAN interface."""
    for device in sorted(devices.iterdir()):
        with suppress(OSError, ValueError):  # gone by now, or no device at all (bonding_masters)
            if int((device / "type").read_text()) == _ARPHRD_CAN:
                yield device.name, bool(int((device / "flags").read_text(), 16) & _IFF_UP)


_INTERRUPTED = (errno.ENETDOWN, errno.ENOBUFS)
_GONE = (errno.ENODEV, errno.ENXIO)
_REPORT_INTERVAL_S = 1.0


class OutlivesInterruptions(can.BusABC):
    """Mixin for a SocketCAN bus: an interface that is down for a while loses frames, not the process.

    While the interface is down (ENETDOWN), or its queue is full because nobody acknowledges (ENOBUFS), a
    frame sent is lost and counted, as on a cable that is unplugged, and nothing is received; standard error
    says so, and again when frames get through. The socket itself stays bound. An interface that was removed
    (ENODEV, ENXIO: an adapter unplugged) never comes back to its sockets: that stays an error.
    """

    channel_info = "CAN bus"
    _lost = 0
    _reported_s = 0.0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame, or lose it while the interface is down."""
        try:
            super().send(msg, timeout)  # type: ignore[safe-super]  # of the bus this is mixed into
        except can.CanOperationError as error:
            if error.error_code not in _INTERRUPTED:
                raise self._explained(error) from error
            if not self._lost:
                self._report(f"{os.strerror(error.error_code)}; frames are lost until it is back")
            self._lost += 1
        else:
            if self._lost and time.monotonic() - self._reported_s >= _REPORT_INTERVAL_S:
                self._report(f"back, {self._lost} frames could not be sent")
                self._lost = 0

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            return super()._recv_internal(timeout)
        except can.CanOperationError as error:
            if error.error_code not in _INTERRUPTED:
                raise self._explained(error) from error
            return None, False

    def _report(self, text: str) -> None:
        self._reported_s = time.monotonic()
        print(f"{self.channel_info}: {text}", file=sys.stderr, flush=True)

    def _explained(self, error: can.CanOperationError) -> can.CanOperationError:
        if error.error_code not in _GONE:
            return error
        return can.CanOperationError(
            f"{self.channel_info} is gone: plug the adapter in again, or see `hil vcan status`"
        )


class SteadySocketcanBus(OutlivesInterruptions, SocketcanBus):
    """python-can's `socketcan`, which a network that is down for a while does not end."""
