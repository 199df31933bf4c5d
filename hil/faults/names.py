"""Names that faults are told: nodes, messages and signals of the contract.

They are what `dbc.messages` makes every DBC define, so that a scenario file can be judged without one.
"""

from typing import get_type_hints

from dbc import messages as layouts
from dbc.codec import signal_name

SIDES = ("controller", "plant")
"""The nodes that may be processes of their own."""

NODES = (*SIDES, "supervisor")

SENDERS = {  # of the messages on the bus
    layouts.DriveCommand: "controller",
    layouts.PositionFeedback: "plant",
    layouts.PositionSetpoint: "supervisor",
    layouts.ControllerCommand: "supervisor",
    layouts.DriveStatus: "plant",
    layouts.PressureFeedback: "plant",
    layouts.ControllerStatus: "controller",
    layouts.ObserverState: "controller",
}
PROTECTED = ("DriveCommand", "PositionFeedback", "PositionSetpoint", "ControllerCommand", "DriveStatus")
"""Messages with counter and CRC."""


def messages() -> tuple[str, ...]:
    """Return the names of the messages on the bus."""
    return tuple(layout.__name__ for layout in SENDERS)


def sender(message: str) -> str:
    """Return the node that sends a message."""
    return next(node for layout, node in SENDERS.items() if layout.__name__ == message)


def signals(message: str) -> tuple[str, ...]:
    """Return the names of the signals that every frame of a message carries."""
    layout = next(layout for layout in SENDERS if layout.__name__ == message)
    hints = get_type_hints(layout, include_extras=True)
    return tuple(signal_name(field) for field, hint in hints.items() if hint.__metadata__[0].page is None)
