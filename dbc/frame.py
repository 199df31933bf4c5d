"""The light CAN frame that all rooms exchange, in SocketCAN's id layout."""

from typing import NamedTuple

EFF_FLAG = 0x8000_0000
"""Set in `Frame.can_id` for a 29-bit identifier, as in SocketCAN's `can_id` word."""


ERR_FLAG = 0x2000_0000
"""Set in the id word of an error frame in a log, as in SocketCAN's."""

BRS_FLAG, ESI_FLAG, FD_FLAG = 1 << 32, 1 << 33, 1 << 34
"""Set in `Frame.can_id` of CAN FD frames: bit rate switch, error state indicator, and in all of them
`FD_FLAG`; 32 bits lower they are the flags byte of SocketCAN's `canfd_frame`."""


class Frame(NamedTuple):
    """A CAN data frame; all that nodes send and get are classic.

    Attributes
    ----------
    can_id : int
        Identifier; bit 31 (`EFF_FLAG`) set for a 29-bit one, bit 34 (`FD_FLAG`) in a CAN FD frame.
    dlc : int
        Number of data bytes, 0..8; of CAN FD one of 0..8, 12, 16, 20, 24, 32, 48, 64.
    data : int
        Payload as an unsigned integer, byte 0 in the low eight bits.
    """

    can_id: int
    dlc: int
    data: int
