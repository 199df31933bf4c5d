"""Conversion at the python-can edge."""

from can import Message

from dbc.frame import EFF_FLAG, Frame


def to_message(time_ns: int, frame: Frame, channel: str | None = None, is_rx: bool = True) -> Message:
    """Return a light frame as a python-can message stamped with bus time."""
    can_id, dlc, data = frame
    return Message(
        timestamp=time_ns / 1e9,
        arbitration_id=can_id & ~EFF_FLAG,
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
        For a remote, error or CAN FD frame.
    """
    if message.is_fd or message.is_remote_frame or message.is_error_frame:
        raise ValueError("only classic data frames are carried")
    can_id = message.arbitration_id | (EFF_FLAG if message.is_extended_id else 0)
    return Frame(can_id, message.dlc, int.from_bytes(message.data, "little"))
