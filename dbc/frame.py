"""The light CAN frame that all rooms exchange, in SocketCAN's id layout."""

from typing import NamedTuple

EFF_FLAG = 0x8000_0000
"""Set in `Frame.can_id` for a 29-bit identifier, as in SocketCAN's `can_id` word."""


ERR_FLAG = 0x2000_0000
"""Set in the id word of an error frame in a log, as in SocketCAN's."""


class Frame(NamedTuple):
    """A classic CAN data frame.

    Attributes
    ----------
    can_id : int
        Identifier; bit 31 (`EFF_FLAG`) set for a 29-bit one.
    dlc : int
        Number of data bytes, 0..8.
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    """

    can_id: int
    dlc: int
    data: int
