"""The embedded bus as a python-can interface: ``can.Bus(interface="hilbus", channel=NAME)``."""

import os
import select
import socket
import time
from contextlib import suppress
from typing import Any

import can
from can import BusABC, CanInitializationError, CanOperationError, CanProtocol, Message

from hil.bus import link
from hil.bus.link import LinkError
from hil.bus.messages import to_frame, to_message


class HilBus(BusABC):
    """A participant of a running hub.

    Frames are received until the hub ends; then the bus is shut down by itself.

    Timestamps are bus time, which is 0 when the hub starts. Filters work in software; a thread sends periodic
    messages. Frames wait in the kernel, never in this object: a readable `fileno` means that one is there,
    and what was sent reaches the bus even if the sender leaves at once. Threads may share a bus.

    Parameters
    ----------
    channel : str or int
        The hub's channel; python-can makes an int of a name that looks like one.
    can_filters : optional
        As in python-can.
    bitrate : int, optional
        The bit rate this program expects, bit/s; with CAN FD the nominal one. The hub has set it already:
        another one is refused, because on a real bus such a participant hears nothing and disturbs everybody.
    data_bitrate : int, optional
        The same behind the bit rate switch of CAN FD frames.
    timing : can.BitTiming or can.BitTimingFd, optional
        The same, as python-can's bit timing; that for CAN FD turns `fd` on.
    fd : bool
        Send and receive CAN FD frames as well; as on SocketCAN, a program that does not ask for them neither
        sends nor hears them.
    receive_own_messages : bool
        Not supported: refused if true.
    greeted : tuple, optional
        A link and the hub's answer from `hil.bus.link.connect`, to be used instead of a new one.

    Raises
    ------
    CanInitializationError
        If there is no such hub, or what is asked for is not what it offers.
    """

    def __init__(
        self,
        channel: str | int | None = None,
        can_filters: Any = None,
        bitrate: int | None = None,
        timing: can.BitTiming | can.BitTimingFd | None = None,
        fd: bool = False,
        data_bitrate: int | None = None,
        receive_own_messages: bool = False,
        greeted: tuple[socket.socket, dict[str, Any]] | None = None,
        **kwargs: Any,
    ) -> None:
        if channel is None:
            raise CanInitializationError("hilbus needs a channel: the NAME of `hil bus --channel NAME`")
        if receive_own_messages:
            raise CanInitializationError(
                "hilbus does not return a program's own messages: listen with a second bus on the channel"
            )
        self.channel = str(channel)
        if isinstance(timing, can.BitTimingFd):
            fd, bitrate, data_bitrate = True, timing.nom_bitrate, timing.data_bitrate
        elif timing is not None:
            bitrate = timing.bitrate
        try:
            self._link, answer = greeted or link.connect(self.channel, {"role": "bus", "fd": bool(fd)})
        except LinkError as error:
            raise CanInitializationError(str(error)) from None
        self.bit_rate: int = answer["bit_rate"]
        self.data_bit_rate: int = answer["data_bit_rate"]
        self.channel_info = f"hilbus channel {self.channel!r}, {self.bit_rate} bit/s"
        self._expect("runs", self.bit_rate, bitrate)
        if fd:
            self.channel_info += f", CAN FD data at {self.data_bit_rate} bit/s"
            self._expect("switches CAN FD data", self.data_bit_rate, data_bitrate)
        self._can_protocol = CanProtocol.CAN_FD if fd else CanProtocol.CAN_20
        self._left = ""
        super().__init__(channel=self.channel, can_filters=can_filters, **kwargs)

    def _expect(self, what: str, bit_rate: int, expected: int | None) -> None:
        if expected not in (None, bit_rate):
            self._link.close()
            raise CanInitializationError(
                f"hilbus channel {self.channel!r} {what} at {bit_rate} bit/s, not at {expected}: "
                "leave the bit rate out or give the hub's"
            )

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a data frame; blocks while the hub is busy, at most `timeout` s if given.

        Raises
        ------
        CanTimeoutError
            If the hub took no frame in that time.
        CanOperationError
            If it is no data frame, one of CAN FD on a bus opened without, or the bus is there no more.
        """
        until_s = time.monotonic() + (timeout or 0.0)
        wait_ms = None if timeout is None else timeout * 1e3
        room = select.poll()  # which, other than select, also returns when the link ends
        try:
            if msg.is_fd and self._can_protocol is not CanProtocol.CAN_FD:
                raise ValueError("open it with fd=True to send CAN FD frames")
            packet = link.pack_frame(to_frame(msg))
            room.register(self._link, select.POLLOUT)
            while room.poll(wait_ms):
                with suppress(BlockingIOError):  # another thread took the place
                    self._link.send(packet, socket.MSG_DONTWAIT)
                    return
                wait_ms = None if timeout is None else max(until_s - time.monotonic(), 0.0) * 1e3
        except (ValueError, OSError) as error:
            raise self._failure("send", error) from None
        raise can.CanTimeoutError(f"{self.channel_info} took no frame within {timeout} s")

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        try:
            if not select.select([self._link], [], [], timeout)[0]:
                return None, False
            packet = self._link.recv(link.MAX_PACKET, socket.MSG_DONTWAIT)
            if not packet:
                self._leave(
                    "the hub has ended"
                )  # an open link would stay readable, and wake asyncio for ever
                raise ConnectionError
        except (BlockingIOError, ConnectionResetError):
            # Another thread was faster; or the hub has ended, and what it sent before is still to be read.
            return None, False
        except (ValueError, OSError) as error:
            raise self._failure("receive", error) from None
        time_ns, frame = link.unpack_timed(packet)
        return to_message(time_ns, frame, self.channel), False

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame is there; -1 when the bus is not."""
        return self._link.fileno()

    def shutdown(self) -> None:
        """Leave the bus; wakes threads that wait in `recv` or `send`. May be called again."""
        self._leave("the bus was shut down")

    def _leave(self, reason: str) -> None:
        if not self._is_shutdown:
            self._left = reason
            super().shutdown()
            with suppress(OSError):  # the hub may have ended before
                self._link.shutdown(socket.SHUT_RDWR)
            self._link.close()

    def _failure(self, what: str, error: Exception) -> CanOperationError:
        ended = "the hub has ended" if isinstance(error, ConnectionError) else error
        return CanOperationError(f"cannot {what} on {self.channel_info}: {self._left or ended}")

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        found = []
        try:
            sockets = sorted(link.socket_directory().glob("*.sock"))
        except LinkError:
            return []
        for path in sockets:
            probe = link.seqpacket_socket()
            probe.setblocking(False)
            try:
                probe.connect(os.fspath(path))
            except OSError:
                continue
            finally:
                probe.close()
            found.append({"interface": "hilbus", "channel": path.stem})
        return found
