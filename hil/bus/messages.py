"""Conversion at the python-can edge."""

from can import Message
from can.util import dlc2len, len2dlc

from dbc.frame import BRS_FLAG, EFF_FLAG, ERR_FLAG, ESI_FLAG, FD_FLAG, Frame


def to_message(time_ns: int, frame: Frame, channel: str | None = None, is_rx: bool = True) -> Message:
    """Return a light frame as a python-can message stamped with bus time."""
    can_id, dlc, data = frame
    return Message(
        timestamp=time_ns / 1e9,
        arbitration_id=can_id & 0x1FFF_FFFF,
        is_error_frame=bool(can_id & ERR_FLAG),
        is_extended_id=bool(can_id & EFF_FLAG),
        dlc=dlc,
        is_fd=bool(can_id & FD_FLAG),
        bitrate_switch=bool(can_id & BRS_FLAG),
        error_state_indicator=bool(can_id & ESI_FLAG),
        data=data.to_bytes(64 if can_id & FD_FLAG else 8, "little")[:dlc],
        channel=channel,
        is_rx=is_rx,
    )


def to_frame(message: Message) -> Frame:
    """Return a python-can message as a light frame; one of CAN FD is filled up to the next length with zeros.

    Raises
    ------
    ValueError
        For a remote or error frame, and for an id, dlc or data that no data frame can have.
    """
    if message.is_remote_frame or message.is_error_frame:
        raise ValueError("only data frames are carried")
    can_id, highest_id = message.arbitration_id, 0x1FFF_FFFF if message.is_extended_id else 0x7FF
    kind, most_bytes = ("CAN FD", 64) if message.is_fd else ("classic", 8)
    if not (0 <= can_id <= highest_id and len(message.data) <= message.dlc <= most_bytes):
        raise ValueError(f"id {can_id:#x} with {len(message.data)} bytes, dlc {message.dlc}: no {kind} frame")
    flags = EFF_FLAG if message.is_extended_id else 0
    if message.is_fd:
        flags |= FD_FLAG | BRS_FLAG * message.bitrate_switch | ESI_FLAG * message.error_state_indicator
    length = dlc2len(len2dlc(message.dlc)) if message.is_fd else message.dlc
    return Frame(can_id | flags, length, int.from_bytes(message.data, "little"))
