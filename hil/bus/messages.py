"""Conversion at the python-can edge."""

from can import Message

from dbc.frame import EFF_FLAG, ERR_FLAG, Frame


def to_message(time_ns: int, frame: Frame, channel: str | None = None, is_rx: bool = True) -> Message:
    """Return a light frame as a python-can message stamped with bus time."""
    can_id, dlc, data = frame
    return Message(
        timestamp=time_ns / 1e9,
        arbitration_id=can_id & ~(EFF_FLAG | ERR_FLAG),
        is_error_frame=bool(can_id & ERR_FLAG),
        is_extended_id=bool(can_id & EFF_FLAG),
        dlc=dlc,
        data=data.to_bytes(8, "little")[:dlc],
        channel=channel,
        is_rx=is_rx,
    )


def to_frame(message: Message) -> Frame:
    """Return a python-can message as a light frame.

    Raises
    ------
    ValueError
        For a remote, error or CAN FD frame, and for an id, dlc or data that no classic frame can have.
    """
    if message.is_fd or message.is_remote_frame or message.is_error_frame:
        raise ValueError("only classic data frames are carried")
    can_id, highest_id = message.arbitration_id, 0x1FFF_FFFF if message.is_extended_id else 0x7FF
    if not (0 <= can_id <= highest_id and len(message.data) <= message.dlc <= 8):
        raise ValueError(
            f"id {can_id:#x} with {len(message.data)} bytes, dlc {message.dlc}: no classic frame"
        )
    return Frame(
        can_id | (EFF_FLAG if message.is_extended_id else 0),
        message.dlc,
        int.from_bytes(message.data, "little"),
    )
