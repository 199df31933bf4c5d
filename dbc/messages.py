"""The messages and signals the code relies on: what a DBC file must define to serve as the contract.

Each class stands for the message of its name and each field for the signal of its name, in raw integers:
`target_velocity` is `TargetVelocity`. The E2E signals `Crc` and `Counter` are not fields: `dbc.e2e` fills
them in.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, NamedTuple


@dataclass(frozen=True, slots=True)
class Raw:
    """Encoding required of a field's signal.

    A field with several of these stands for whichever signal the message's multiplexer selects; all of them
    must lie on the same bits.

    Attributes
    ----------
    length : int
        Length in bits.
    signed : bool
        Whether the raw value is in two's complement.
    factor : float
        Physical value of one raw bit.
    signal : str or None
        Name of the signal, where it is not that of the field.
    page : int or None
        Value of the multiplexer that selects the signal; None for one that is always there.
    """

    length: int
    signed: bool = False
    factor: float = 1.0
    signal: str | None = None
    page: int | None = None


Flag = Annotated[int, Raw(1)]
U16 = Annotated[int, Raw(16)]
Velocity = Annotated[int, Raw(16, signed=True, factor=0.25)]
Pressure = Annotated[int, Raw(16, factor=0.01)]


class DriveCommand(NamedTuple):
    """Controller to drive: CiA 402 controlword; velocity in 0.25 rpm."""

    controlword: U16
    target_velocity: Velocity


class PositionFeedback(NamedTuple):
    """Position sensor to controller: position in 1 µm."""

    sensor_status: Annotated[int, Raw(4)]
    position: Annotated[int, Raw(32, signed=True, factor=1e-6)]


class PositionSetpoint(NamedTuple):
    """Supervisor to controller: position in 0.1 µm."""

    position: Annotated[int, Raw(32, signed=True, factor=1e-7)]


class ControllerCommand(NamedTuple):
    """Supervisor to controller: mode."""

    enable: Flag
    control_law: Annotated[int, Raw(3)]
    fault_reset: Flag


class DriveStatus(NamedTuple):
    """Drive to controller: CiA 402 statusword; velocity in 0.25 rpm."""

    statusword: U16
    actual_velocity: Velocity


class PressureFeedback(NamedTuple):
    """Drive to all: absolute pressures in 0.01 bar."""

    pressure_a: Pressure
    pressure_b: Pressure
    pressure_accumulator: Pressure


class ControllerStatus(NamedTuple):
    """Controller to supervisor: state, faults, execution time in 0.5 % of the period, counts."""

    state: Annotated[int, Raw(4)]
    control_law: Annotated[int, Raw(3)]
    feedback_lost: Flag
    feedback_corrupt: Flag
    feedback_invalid: Flag
    setpoint_lost: Flag
    setpoint_corrupt: Flag
    setpoint_invalid: Flag
    command_lost: Flag
    command_corrupt: Flag
    drive_status_lost: Flag
    drive_status_corrupt: Flag
    drive_not_enabled: Flag
    drive_fault: Flag
    calibration_invalid: Flag
    mailbox_overrun: Flag
    position_stuck: Flag
    execution_time: Annotated[int, Raw(8, factor=0.5)]
    saturations: U16
    mailbox_overruns: U16


class ObserverState(NamedTuple):
    """Controller to tools: one quantity per page, in the kernel's fixed-point formats at a period of 1 ms."""

    page: Annotated[int, Raw(8)]
    cycle: U16
    value: Annotated[
        int,
        Raw(32, signed=True, factor=2.0**-31, signal="TdPosition", page=0),
        Raw(32, signed=True, factor=2.0**-38 * 1e3, signal="TdVelocity", page=1),
        Raw(32, signed=True, factor=2.0**-40 * 1e6, signal="TdAcceleration", page=2),
        Raw(32, signed=True, factor=2.0**-31, signal="EsoPosition", page=3),
        Raw(32, signed=True, factor=2.0**-38 * 1e3, signal="EsoVelocity", page=4),
        Raw(32, signed=True, factor=2.0**-40 * 1e6, signal="EsoAcceleration", page=5),
        Raw(32, signed=True, factor=2.0**-42 * 1e9, signal="EsoDisturbance", page=6),
    ]


class BenchCommand(IntEnum):
    """What a BenchControl asks for."""

    NONE = 0
    RESET = 1
    SET_FAULT = 2
    SCALE_PARAMETER = 3


class BenchFault(IntEnum):
    """Faults that a SET_FAULT switches on; the value is in 1e-6 of the unit given here, 0 switches it off."""

    NONE = 0
    """Switches all faults off, whatever the value."""
    SENSOR_STUCK = 1
    """On: the position last reported is reported again and again; counter and CRC go on."""
    SENSOR_BIAS = 2
    """m, added to the position measured."""
    SENSOR_DRIFT = 3
    """m/s, from when it is switched on; what has drifted away is gone when it is switched off."""
    SENSOR_NOISE = 4
    """m RMS, white, beside the noise that the sensor has by itself."""
    SENSOR_DROPOUT = 5
    """On: no PositionFeedback is sent, and its counter rests."""
    SENSOR_STATUS = 6
    """The SensorStatus reported, as a number."""


class BenchParameter(IntEnum):
    """Parameters that a SCALE_PARAMETER multiplies; the value is a factor on the machine as built, 1e-6."""

    BULK_MODULUS = 1
    EFFICIENCY = 2
    LEAK = 3
    PRECHARGE = 4
    RELIEF_CRACK = 5
    """Of both valves; 0: stuck open."""
    MOTOR_SPEED = 6
    MOTOR_ACCELERATION = 7
    MASS = 8


class BenchControl(NamedTuple):
    """Bench to the nodes under test; `command` says what `identifier` and `value` mean.

    1 reset: value is the initial position in 0.1 µm. 2 fault: identifier of `BenchFault`, magnitude in 1e-6
    of its unit. 3 parameter: identifier of `BenchParameter`, factor on the machine as built in 1e-6.
    """

    command: Annotated[int, Raw(8)]
    identifier: Annotated[int, Raw(16, signal="FaultId", page=2), Raw(16, signal="ParameterId", page=3)]
    value: Annotated[
        int,
        Raw(32, signed=True, factor=1e-7, signal="InitialPosition", page=1),
        Raw(32, signed=True, factor=1e-6, signal="FaultValue", page=2),
        Raw(32, signed=True, factor=1e-6, signal="ParameterScale", page=3),
    ]


class BenchLoad(NamedTuple):
    """Bench to the machine: force on the rod in 1 N, positive resists extension."""

    force: Annotated[int, Raw(32, signed=True)]
