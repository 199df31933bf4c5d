"""AUTOSAR end-to-end protection, profile 2: CRC-8, 4-bit counter, one DataID per counter value.

The protected payload carries the CRC in byte 0 and the counter in the low nibble of byte 1. Requirement
numbers (SWS_E2E_...) are those of the AUTOSAR E2E Library specification, Classic Platform 4.3.1; from
release R19-11 on the same behaviour is part of the Foundation's E2E Protocol Specification.
A CRC finds errors; it does not authenticate.
"""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from dbc import profile2
from dbc.jit import entry_point, njit
from dbc.profile2 import LOST_DATA, MAX_COUNTER, STATE_SIZE
from dbc.restricted import high_half, low_half, register

SOURCES = ("dbc.e2e", "dbc.machine", "dbc.profile2", "dbc.restricted")
"""What code that is compiled with these functions depends on."""


register(profile2)


class Status(IntEnum):
    """Result of a check, with the values of ``E2E_P02CheckStatusType``."""

    OK = profile2.OK
    NONEWDATA = profile2.NONEWDATA
    WRONGCRC = profile2.WRONGCRC
    SYNC = profile2.SYNC
    INITIAL = profile2.INITIAL
    REPEATED = profile2.REPEATED
    OKSOMELOST = profile2.OKSOMELOST
    WRONGSEQUENCE = profile2.WRONGSEQUENCE


ACCEPTED = (int(Status.OK), int(Status.OKSOMELOST), int(Status.SYNC))
"""Statuses whose data may be used."""


@njit("int64(uint64, int64, int64)", depends=SOURCES)
def profile2_crc(data: int, dlc: int, data_id: int) -> int:
    """Return the profile-2 CRC of a payload (SWS_E2E_00133).

    Parameters
    ----------
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    dlc : int
        Number of payload bytes, 2..8.
    data_id : int
        DataID that belongs to the payload's counter, 0..255.
    """
    return profile2.profile2_crc(low_half(data), high_half(data), dlc, data_id)


@njit("uint64(int64[::1], int64[::1], uint64)", depends=SOURCES)
def profile2_protect(counter, configuration, data):  # type: ignore[no-untyped-def]
    """``E2E_P02Protect``: return the payload with the next counter and the CRC filled in.

    Parameters
    ----------
    counter : array of int64, shape (1,)
        The counter last sent, updated in place; 0 at power-on.
    configuration : array of int64, shape (CONFIGURATION_SIZE,)
        As from `receiver_configuration`: DataIDs and length are those of the sender, too.
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    """
    counter[0] = (counter[0] + 1) & MAX_COUNTER
    low = profile2.profile2_protect(configuration, 0, counter[0], low_half(data), high_half(data))
    return (data & ~np.uint64(0xFFFF_FFFF)) | np.uint64(low)


@njit("int64(int64[::1], int64[::1], uint64, int64)", depends=SOURCES)
def profile2_check(state, configuration, data, arrived):  # type: ignore[no-untyped-def]
    """``E2E_P02Check``: return the status of one received payload.

    Parameters
    ----------
    state : array of int64, shape (STATE_SIZE,)
        The receiver's state, updated in place; all zero at power-on.
    configuration : array of int64, shape (CONFIGURATION_SIZE,)
        As from `receiver_configuration`.
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    arrived : int
        0 if nothing arrived since the last call; `data` is not looked at then.
    """
    return profile2.profile2_check(state, 0, configuration, 0, low_half(data), high_half(data), arrived)


def receiver_configuration(
    data_ids: Sequence[int],
    dlc: int,
    *,
    max_delta_counter_init: int = 1,
    max_no_new_or_repeated_data: int = 3,
    sync_counter_init: int = 1,
) -> np.ndarray:
    """Return a receiver's configuration as `profile2_check` takes it.

    Parameters
    ----------
    data_ids : sequence of int
        The message's 16 DataIDs, indexed by the counter.
    dlc : int
        Payload length in bytes, 2..8. A frame of another length is the caller's to refuse.
    max_delta_counter_init : int
        Largest step of the counter accepted, one more than this at the first check after valid data and
        growing by one with every further check (SWS_E2E_00136).
    max_no_new_or_repeated_data : int
        Consecutive checks without new data after which the counter has to be synchronised again.
    sync_counter_init : int
        Valid counters in a row needed for that synchronisation. With 0, a wrong sequence does not move the
        expected counter.
    """
    words = (dlc, max_delta_counter_init, max_no_new_or_repeated_data, sync_counter_init)
    return np.array([*_checked_data_ids(data_ids), *words], np.int64)


_protect, _check = entry_point(profile2_protect), entry_point(profile2_check)


class Protector:
    """Sender side: ``E2E_P02Protect`` with its state.

    Parameters
    ----------
    data_ids : sequence of int
        The message's 16 DataIDs, indexed by the counter.
    dlc : int
        Payload length in bytes, 2..8.
    """

    __slots__ = ("_configuration", "_state")

    def __init__(self, data_ids: Sequence[int], dlc: int) -> None:
        self._configuration = receiver_configuration(data_ids, dlc)
        self._state = np.zeros(1, np.int64)

    def protect(self, data: int) -> int:
        """Return `data` with the next counter and the CRC filled in; the first counter sent is 1."""
        protected: int = _protect(self._state, self._configuration, data)
        return protected


class Checker:
    """Receiver side: ``E2E_P02Check`` with its configuration and state.

    Parameters
    ----------
    data_ids, dlc, **configuration
        As for `receiver_configuration`.
    """

    __slots__ = ("_configuration", "_state")

    def __init__(self, data_ids: Sequence[int], dlc: int, **configuration: int) -> None:
        self._configuration = receiver_configuration(data_ids, dlc, **configuration)
        self._state = np.zeros(STATE_SIZE, np.int64)

    @property
    def lost_data(self) -> int:
        """Messages lost before the last valid one; meaningful for `Status.OK` and `Status.OKSOMELOST`."""
        return int(self._state[LOST_DATA])

    def check(self, data: int | None) -> Status:
        """Check one received payload; None means that nothing arrived since the last call."""
        return Status(_check(self._state, self._configuration, data or 0, data is not None))


def _checked_data_ids(data_ids: Sequence[int]) -> tuple[int, ...]:
    if len(data_ids) != MAX_COUNTER + 1 or not all(0 <= data_id <= 0xFF for data_id in data_ids):
        raise ValueError(f"profile 2 needs 16 DataIDs of 0..255, got {list(data_ids)}")
    return tuple(data_ids)
