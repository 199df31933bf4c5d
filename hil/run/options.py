"""What a rig and a run are asked for, and what a run leaves for the measurements."""

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from firmware_py.chosen_firmware import ChosenFirmware
from firmware_py.chosen_tuning import ChosenTuning, chosen_tuning
from firmware_py.node import EXECUTION_NS
from hil.bus.wire import DEFAULT_DATA_BIT_RATE
from hil.faults import names
from hil.run.stopping import StopFlag
from hil.scenario import Scenario, controller_of
from plant_sim.machine import Machine

DEFAULT_BIT_RATE = 1_000_000
INTERRUPTED = "interrupted"
"""`Recording.ending` of a run that was asked to stop."""

SIDES = frozenset(names.SIDES)
"""The nodes that may be processes of their own."""

HUB_GREETING = "hilbus channel"
"""What a hub process says first when it serves."""


class BenchError(Exception):
    """The run cannot start: the message says what is wrong and what to do."""


class InterruptedRunError(BenchError):
    """The run was asked to stop before it began."""


def check_bit_rate(bit_rate: int) -> None:
    """Refuse a bit rate that classic CAN has not.

    Raises
    ------
    BenchError
        If it is not from 10 kbit/s to 1 Mbit/s.
    """
    if not 10_000 <= bit_rate <= 1_000_000:
        raise BenchError(f"bit rate {bit_rate} is not from 10000 to 1000000 bit/s")


def check_data_bit_rate(data_bit_rate: int, bit_rate: int) -> None:
    """Refuse a bit rate to which no CAN FD frame switches.

    Raises
    ------
    BenchError
        If it is below the nominal one or above 8 Mbit/s.
    """
    if not bit_rate <= data_bit_rate <= 8_000_000:
        raise BenchError(
            f"CAN FD data bit rate {data_bit_rate} is not from {bit_rate} (the bit rate) to 8000000 bit/s"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """What a bench is made of.

    Attributes
    ----------
    record_directory : Path
        Private directory for what processes leave.
    machine : Machine
        What the plant is.
    tuning : ChosenTuning
        What the firmware is calibrated with.
    firmware : ChosenFirmware
        What runs it.
    bit_rate : int or None
        Bit/s; None is `DEFAULT_BIT_RATE` on a simulated wire, and on an adapter what python-can's
        configuration or the adapter itself says.
    data_bit_rate : int
        Bit/s at which a simulated wire carries CAN FD data; for bus load, what an adapter is taken to do.
    dbc : Path or None
        Another DBC than the packaged one.
    interface, channel : str or None
        python-can interface of a real-time run; in lock-step the hub's channel.
    rt_ratio : Fraction
        Simulated time per wall time of a real-time run.
    started : frozenset of str
        Which of `SIDES` a real-time rig starts; the others are on the bus already, or come by themselves.
    start_timeout_s, answer_timeout_s : float
        Wall time for processes to come up, and to answer one event, s.
    stopped : StopFlag
        Ends start-up and runs early.
    """

    record_directory: Path
    machine: Machine = field(default_factory=Machine)
    tuning: ChosenTuning = field(default_factory=chosen_tuning)
    firmware: ChosenFirmware = field(default_factory=ChosenFirmware)
    bit_rate: int | None = None
    data_bit_rate: int = DEFAULT_DATA_BIT_RATE
    dbc: Path | None = None
    interface: str | None = None
    channel: str | None = None
    rt_ratio: Fraction = Fraction(1)
    started: frozenset[str] = SIDES
    start_timeout_s: float = 120.0
    answer_timeout_s: float = 10.0
    stopped: StopFlag = field(default_factory=StopFlag)

    def __post_init__(self) -> None:
        check_bit_rate(self.wire_bit_rate if self.bit_rate is None else self.bit_rate)
        check_data_bit_rate(self.data_bit_rate, self.wire_bit_rate)

    @property
    def wire_bit_rate(self) -> int:
        """Bit/s of the wire; on an adapter that was not told one, an assumption."""
        return self.bit_rate or DEFAULT_BIT_RATE


@dataclass(frozen=True, slots=True)
class RunOptions(RigOptions):
    """One scenario on a rig of its own.

    Attributes
    ----------
    scenario : Scenario
        What is played.
    controller : str
        Control law, one of `hil.scenario.CONTROLLERS`; by default the tuning's own.
    machine : Machine
        The scenario's.
    progress : callable
        Told the simulated time, s.
    """

    scenario: Scenario
    controller: str = ""
    progress: Callable[[float], None] = lambda simulated_s: None
    machine: Machine = field(init=False)

    def __post_init__(self) -> None:
        RigOptions.__post_init__(self)
        object.__setattr__(self, "machine", self.scenario.machine)
        object.__setattr__(self, "controller", self.controller or controller_of(self.tuning.calibration.law))


@dataclass(frozen=True, slots=True)
class Recording:
    """What a run left.

    Attributes
    ----------
    traffic : ndarray of uint64, shape (frames, 4)
        Bus time of each frame's end (ns), id, dlc, data; see `hil.bus.wire.Wire.traffic`.
    supervisor, plant, controller : dict of ndarray, or None
        The nodes' records; None if the process did not live to write it, or is not ours.
    start_ns : int
        Bus time of the scenario's first period.
    simulated_s, wall_s, startup_s : float
        Simulated time; wall time it took; wall time before it, s.
    ending : str
        Empty if the scenario was played to its end, else what ended it.
    broken : bool
        Whether a process was lost.
    payloads : ndarray of uint64, shape (CAN FD frames, 8)
        What the rows of `traffic` have no room for.
    data_bit_rate : int
        Bit/s of CAN FD data.
    execution_ns : int
        The firmware's, from its timer to transmission.
    notes : dict
        What only some modes have: frames injected, drops, lateness.
    """

    traffic: np.ndarray
    supervisor: dict[str, np.ndarray]
    plant: dict[str, np.ndarray] | None
    controller: dict[str, np.ndarray] | None
    start_ns: int
    simulated_s: float
    wall_s: float
    startup_s: float
    ending: str = ""
    broken: bool = False
    payloads: np.ndarray = field(default_factory=lambda: np.zeros((0, 8), np.uint64))
    data_bit_rate: int = DEFAULT_DATA_BIT_RATE
    execution_ns: int = EXECUTION_NS
    notes: dict[str, object] = field(default_factory=dict)
