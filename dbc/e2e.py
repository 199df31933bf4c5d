"""AUTOSAR end-to-end protection, profile 2: CRC-8, 4-bit counter, one DataID per counter value.

The protected payload carries the CRC in byte 0 and the counter in the low nibble of byte 1. Requirement
numbers (SWS_E2E_...) are those of the AUTOSAR E2E Library specification, Classic Platform 4.3.1; from
release R19-11 on the same behaviour is part of the Foundation's E2E Protocol Specification.
A CRC finds errors; it does not authenticate.
"""

from collections.abc import Sequence
from enum import IntEnum

from dbc.jit import njit

MAX_COUNTER = 15


class Status(IntEnum):
    """Result of a check, with the values of ``E2E_P02CheckStatusType``."""

    OK = 0x00
    NONEWDATA = 0x01
    WRONGCRC = 0x02
    SYNC = 0x03
    INITIAL = 0x04
    REPEATED = 0x08
    OKSOMELOST = 0x20
    WRONGSEQUENCE = 0x40


ACCEPTED = frozenset({Status.OK, Status.OKSOMELOST, Status.SYNC})
"""Statuses whose data may be used (``E2E_P02MapStatusToSM`` with the R4.2 profile behaviour)."""


@njit("int64(uint64, int64, int64)")
def profile2_crc(data: int, dlc: int, data_id: int) -> int:
    """Return the profile-2 CRC of a payload (SWS_E2E_00133).

    CRC-8 with polynomial 0x2F, initial value and final XOR 0xFF, over bytes 1 to `dlc` - 1 and the DataID.

    Parameters
    ----------
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    dlc : int
        Number of payload bytes, 2..8.
    data_id : int
        DataID that belongs to the payload's counter, 0..255.
    """
    crc = 0xFF
    for position in range(1, dlc + 1):
        byte = data_id if position == dlc else (data >> (8 * position)) & 0xFF
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) & 0xFF) ^ (0x2F if crc & 0x80 else 0)
    return crc ^ 0xFF


class Protector:
    """Sender side: ``E2E_P02Protect`` with its state.

    Parameters
    ----------
    data_ids : sequence of int
        The message's 16 DataIDs, indexed by the counter.
    dlc : int
        Payload length in bytes, 2..8.
    """

    __slots__ = ("_counter", "_data_ids", "_dlc")

    def __init__(self, data_ids: Sequence[int], dlc: int) -> None:
        self._data_ids = _checked_data_ids(data_ids)
        self._dlc = dlc
        self._counter = 0

    def protect(self, data: int) -> int:
        """Return `data` with the next counter and the CRC filled in; the first counter sent is 1."""
        counter = self._counter = (self._counter + 1) & MAX_COUNTER
        data = data & ~0xFFF | counter << 8
        crc: int = profile2_crc(data, self._dlc, self._data_ids[counter])
        return data | crc


class Checker:
    """Receiver side: ``E2E_P02Check`` with its configuration and state.

    Parameters
    ----------
    data_ids : sequence of int
        The message's 16 DataIDs, indexed by the counter.
    dlc : int
        Payload length in bytes, 2..8. A frame of another length is the caller's to refuse.
    max_delta_counter_init : int
        The largest step of the counter that is accepted is one more than this at the first check after valid
        data, and grows by one with every further check (SWS_E2E_00136).
    max_no_new_or_repeated_data : int
        Consecutive checks without new data after which the counter has to be synchronised again.
    sync_counter_init : int
        Valid counters in a row needed for that synchronisation. With 0, a wrong sequence does not move the
        expected counter.

    Attributes
    ----------
    lost_data : int
        Messages lost before the last valid one; meaningful for `Status.OK` and `Status.OKSOMELOST`.
    """

    __slots__ = (
        "_data_ids",
        "_dlc",
        "_last_valid_counter",
        "_max_delta_counter",
        "_max_delta_counter_init",
        "_max_no_new_or_repeated_data",
        "_no_new_or_repeated_data_counter",
        "_sync_counter",
        "_sync_counter_init",
        "_wait_for_first_data",
        "lost_data",
    )

    def __init__(
        self,
        data_ids: Sequence[int],
        dlc: int,
        *,
        max_delta_counter_init: int = 1,
        max_no_new_or_repeated_data: int = 3,
        sync_counter_init: int = 1,
    ) -> None:
        self._data_ids = _checked_data_ids(data_ids)
        self._dlc = dlc
        self._max_delta_counter_init = max_delta_counter_init
        self._max_no_new_or_repeated_data = max_no_new_or_repeated_data
        self._sync_counter_init = sync_counter_init
        self._last_valid_counter = 0
        self._max_delta_counter = 0
        self._wait_for_first_data = True
        self._sync_counter = 0
        self._no_new_or_repeated_data_counter = 0
        self.lost_data = 0

    def check(self, data: int | None) -> Status:
        """Check one received payload; None means that nothing arrived since the last call."""
        if self._max_delta_counter < MAX_COUNTER:
            self._max_delta_counter += 1
        if data is None:
            self._count_no_new_or_repeated_data()
            return Status.NONEWDATA
        counter = data >> 8 & MAX_COUNTER
        if profile2_crc(data, self._dlc, self._data_ids[counter]) != data & 0xFF:
            return Status.WRONGCRC
        if self._wait_for_first_data:
            self._wait_for_first_data = False
            self._accept(counter)
            return Status.INITIAL
        delta = (counter - self._last_valid_counter) & MAX_COUNTER
        if delta == 0:
            self._count_no_new_or_repeated_data()
            return Status.REPEATED
        if delta > self._max_delta_counter:
            return self._wrong_sequence(counter)
        self._accept(counter)
        self.lost_data = delta - 1
        return self._synchronise(Status.OK if delta == 1 else Status.OKSOMELOST)

    def _accept(self, counter: int) -> None:
        self._max_delta_counter = self._max_delta_counter_init
        self._last_valid_counter = counter

    def _count_no_new_or_repeated_data(self) -> None:
        if self._no_new_or_repeated_data_counter < MAX_COUNTER:
            self._no_new_or_repeated_data_counter += 1

    def _wrong_sequence(self, counter: int) -> Status:
        """SWS_E2E_00145: the counter jumped too far."""
        self._no_new_or_repeated_data_counter = 0
        self._sync_counter = self._sync_counter_init
        if self._sync_counter > 0:
            self._accept(counter)
        return Status.WRONGSEQUENCE

    def _synchronise(self, synchronised: Status) -> Status:
        """SWS_E2E_00298, 00299: `synchronised` once enough counters in a row were valid, else SYNC."""
        stale = self._no_new_or_repeated_data_counter > self._max_no_new_or_repeated_data
        self._no_new_or_repeated_data_counter = 0
        if stale:
            self._sync_counter = self._sync_counter_init
            return Status.SYNC
        if self._sync_counter > 0:
            self._sync_counter -= 1
            return Status.SYNC
        return synchronised


def _checked_data_ids(data_ids: Sequence[int]) -> tuple[int, ...]:
    if len(data_ids) != MAX_COUNTER + 1 or not all(0 <= data_id <= 0xFF for data_id in data_ids):
        raise ValueError(f"profile 2 needs 16 DataIDs of 0..255, got {list(data_ids)}")
    return tuple(data_ids)
