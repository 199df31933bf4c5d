"""The embedded bus as a python-can interface: ``can.Bus(interface="hilbus", channel=NAME)``."""

import os
import select
import socket
from typing import Any

import can
from can import BusABC, CanInitializationError, CanOperationError, CanProtocol, Message

from hil.bus import link
from hil.bus.link import LinkError
from hil.bus.messages import to_frame, to_message


class HilBus(BusABC):
    """A participant of a running hub.

    Parameters
    ----------
    channel : str or int
        The hub's channel; python-can makes a number of one that consists of digits.
    can_filters : optional
        As in python-can; filtering is done in software.
    greeted : tuple, optional
        A link and the hub's answer from `hil.bus.link.connect`, to be used instead of a new one.

    Raises
    ------
    CanInitializationError
        If there is no such hub, or it refuses.
    """

    def __init__(
        self,
        channel: str | int,
        can_filters: Any = None,
        greeted: tuple[socket.socket, dict[str, Any]] | None = None,
        **kwargs: Any,
    ) -> None:
        channel = str(channel)
        try:
            self._link, answer = greeted or link.connect(channel, {"role": "bus"})
        except LinkError as error:
            self._is_shutdown = True
            raise CanInitializationError(str(error)) from error
        self.bit_rate: int = answer["bit_rate"]
        self.channel = channel
        self.channel_info = f"hilbus channel {channel!r}, {self.bit_rate} bit/s"
        self._can_protocol = CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a classic data frame; blocks while the hub is busy, at most `timeout` s if given."""
        try:
            packet = link.pack_frame(to_frame(msg))
            ready = timeout is None or select.select([], [self._link], [], timeout)[1]
            if ready:
                self._link.send(packet)
        except (ValueError, OSError) as error:
            raise CanOperationError(f"cannot send on {self.channel_info}: {error}") from error
        if not ready:
            raise can.CanTimeoutError(f"{self.channel_info} took no frame within {timeout} s")

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        try:
            if not select.select([self._link], [], [], timeout)[0]:
                return None, False
            packet = self._link.recv(link.MAX_PACKET, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None, False
        except (ValueError, OSError) as error:
            raise CanOperationError(f"cannot receive on {self.channel_info}: {error}") from error
        if not packet:
            raise CanOperationError(f"the hub of {self.channel_info} has ended")
        time_ns, frame = link.unpack_timed(packet)
        return to_message(time_ns, frame, self.channel), False

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame is there."""
        return self._link.fileno()

    def shutdown(self) -> None:
        """Leave the bus; may be called again."""
        if not self._is_shutdown:
            super().shutdown()
            self._link.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        found = []
        try:
            sockets = sorted(link.socket_directory().glob("*.sock"))
        except LinkError:
            return []
        for path in sockets:
            probe = link.seqpacket_socket()
            try:
                probe.connect(os.fspath(path))
            except OSError:
                continue
            finally:
                probe.close()
            found.append({"interface": "hilbus", "channel": path.stem})
        return found
