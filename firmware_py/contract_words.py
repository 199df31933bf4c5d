"""Host side: what the firmware is told of the contract, see `firmware_py.task_layout`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dbc.codec import FieldBits, MessageCodec
from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py import task_layout as at

PLAUSIBLE_POSITION_UM = -10_000, 410_000
PLAUSIBLE_SETPOINT_0P1UM = -10_000, 4_010_000
USABLE_SENSOR_STATUS = 0, 1

Messages = tuple[MessageCodec[..., Any], ...]


def received(contract: Contract) -> Messages:
    """Return the messages that have mailboxes, in their order."""
    return (
        contract.position_feedback,
        contract.position_setpoint,
        contract.controller_command,
        contract.drive_status,
    )


def sent(contract: Contract) -> Messages:
    """Return the messages the firmware sends, in their order."""
    return contract.drive_command, contract.controller_status, contract.observer_state


def expectation(message: MessageCodec[..., Any], plausible: Mapping[str, tuple[int, int]]) -> list[int]:
    """Return what is expected of a protected message.

    Parameters
    ----------
    message : MessageCodec
        The message; its cycle time sets the staleness limit.
    plausible : mapping of str to (int, int)
        Lowest and highest raw value of a field that may be used; of a field not named, all are.
    """
    cycle_periods = max(message.cycle_time_ns // PERIOD_NS, 1)
    words = message.receiver_configuration().tolist()
    words += [_signed(message.can_id), cycle_periods, at.STALE_CYCLES * cycle_periods, len(message.fields)]
    for field in message.fields:
        low, high = plausible.get(field.name, (field.minimum, field.minimum + field.mask))
        words += [field.start, field.length, int(field.signed), low, high]
    return words + [0] * (at.EXPECTATION_SIZE - len(words))


def contract_words(contract: Contract) -> np.ndarray:
    """Return the firmware's `contract` array, int32."""
    plausible: dict[str, dict[str, tuple[int, int]]] = {
        contract.position_feedback.name: {
            "sensor_status": USABLE_SENSOR_STATUS,
            "position": PLAUSIBLE_POSITION_UM,
        },
        contract.position_setpoint.name: {"position": PLAUSIBLE_SETPOINT_0P1UM},
    }
    words = []
    for message in received(contract):
        words += expectation(message, plausible.get(message.name, {}))
    words += contract.drive_command.receiver_configuration().tolist()
    for message in sent(contract):
        words += _layout(message, message.fields)
    words += _layout(contract.bench_control, contract.bench_control.fields[:1])
    return np.array(words, np.int32)


def _layout(message: MessageCodec[..., Any], fields: Sequence[FieldBits]) -> list[int]:
    return [
        _signed(message.can_id),
        message.dlc,
        *(word for field in fields for word in (field.start, field.length)),
    ]


def _signed(can_id: int) -> int:
    return can_id - (can_id >> 31 << 32)
