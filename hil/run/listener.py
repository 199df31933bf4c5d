"""What a real-time bench hears: every frame on the bus, and when."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from threading import Thread

import can
import numpy as np

from dbc.frame import FD_FLAG, Frame
from hil.bus.messages import to_frame
from hil.bus.wire_time import fd_bits, fd_log_data, payload_words
from hil.run.realtime import shared_ns

_POLL_S = 0.05


class Listener:
    """Logs a bus from a thread of its own.

    The thread has ordinary priority: two threads under SCHED_FIFO that wait for the interpreter would leave a
    single processor no time for the one that has it.

    Parameters
    ----------
    bus : can.BusABC
        Only listened to.

    Attributes
    ----------
    newest_ns : dict of int to int
        When each id was heard last, ns of `time.monotonic_ns`.
    raised : Exception or None
        Why it hears no more.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self.raised: Exception | None = None
        self.newest_ns: dict[int, int] = {}
        self._bus = bus
        self._stopping = False
        self._heard: list[tuple[int, int, int, int, int]] = []  # heard, stamped (ns), id, dlc, data
        self._payloads: list[np.ndarray] = []

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen for the length of the context."""
        thread = Thread(target=self._run, name="listener", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stopping = True
            thread.join()

    def forget(self) -> None:
        """Forget what was heard so far."""
        self._heard = []

    def times_ns(self, can_id: int) -> list[int]:
        """Return the bus's own time stamps of a message, ns."""
        return [stamp_ns for _, stamp_ns, heard_id, _, _ in self._heard if heard_id == can_id]

    @property
    def payloads(self) -> np.ndarray:
        """Payloads of CAN FD frames; see `hil.run.options.Recording`."""
        return np.array(self._payloads, np.uint64).reshape(-1, 8)

    def traffic(self, ratio: Fraction) -> np.ndarray:
        """Return what was heard on the nodes' time base; see `hil.run.options.Recording`."""
        heard, offset_ns = list(self._heard), self._clock_offset_ns()
        rows = [(shared_ns(stamp_ns + offset_ns, ratio), *frame) for _, stamp_ns, *frame in heard]
        return np.array(rows, dtype=np.uint64).reshape(-1, 4)

    def node_ns(self, stamp_ns: int, ratio: Fraction) -> int:
        """Return a time of the bus's clock on the nodes' time base."""
        return shared_ns(stamp_ns + self._clock_offset_ns(), ratio)

    def _clock_offset_ns(self) -> int:
        """Return how far our clock is ahead of the bus's; the frame that was passed on fastest ties them."""
        return min((heard_ns - stamp_ns for heard_ns, stamp_ns, *_ in list(self._heard)), default=0)

    def _run(self) -> None:
        try:
            while not self._stopping:
                message = self._bus.recv(_POLL_S)
                if message is not None:
                    self._take(message)
        except Exception as error:  # whatever a driver raises: the rig tells
            self.raised = error

    def _take(self, message: can.Message) -> None:
        if not (message.is_error_frame or message.is_remote_frame):
            frame = to_frame(message)
            if frame.can_id & FD_FLAG:
                frame = self._kept(frame)
            now_ns = time.monotonic_ns()
            self.newest_ns[frame.can_id] = now_ns
            self._heard.append((now_ns, round(message.timestamp * 1e9), *frame))

    def _kept(self, frame: Frame) -> Frame:
        """Keep a CAN FD frame's payload; return the frame with what a log has for its data."""
        payload = payload_words(frame.data)
        self._payloads.append(payload)
        lengths = fd_bits(frame.can_id, frame.dlc, payload)
        return frame._replace(data=fd_log_data(lengths, len(self._payloads) - 1))
