"""Host side: what runs the firmware, and how long a control period takes on it."""

import argparse
import importlib.util
import json
import math
from dataclasses import dataclass
from pathlib import Path

from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.emulated.processors import TARGETS
from firmware_py.node import EXECUTION_NS, Controller

PYTHON = "python"
PROCESSORS = tuple(TARGETS)
FIRMWARES = (PYTHON, *PROCESSORS)
FIGURES = "clock_mhz", "execution_us"
COST = Path(__file__).parent / "emulated" / "cost.json"


class FirmwareError(ValueError):
    """The firmware cannot run as asked; one line that says what to do."""


@dataclass(frozen=True, slots=True)
class ChosenFirmware:
    """What runs the firmware.

    Attributes
    ----------
    name : str
        One of `FIRMWARES`: Python, or the exported C on an emulated processor.
    clock_mhz : float or None
        The processor's clock; None is the usual one.
    execution_us : float or None
        From the timer to transmission; None is the worst that was measured on the processor at its clock (see
        `hil cost`), and for Python an assumption.

    Raises
    ------
    FirmwareError
        If there is no such firmware, or a figure is out of range.
    """

    name: str = PYTHON
    clock_mhz: float | None = None
    execution_us: float | None = None

    def __post_init__(self) -> None:
        if self.name not in FIRMWARES:
            raise FirmwareError(f"there is no firmware {self.name!r}: choose one of {', '.join(FIRMWARES)}")
        if self.clock_mhz is not None and self.name == PYTHON:
            raise FirmwareError(f"a clock needs a processor: {' or '.join(PROCESSORS)}")
        if self.clock_mhz is not None:
            check_clock(self.clock_mhz)
        if self.execution_us is not None and not math.isfinite(self.execution_us):
            raise FirmwareError(f"an execution time of {self.execution_us:g} µs is no time")
        if not 0 <= self.execution_ns < PERIOD_NS // 2:
            raise FirmwareError(
                f"an execution time of {self.execution_ns / 1e3:g} µs is not below half a control period, "
                f"{PERIOD_NS // 2000} µs"
            )

    @property
    def execution_ns(self) -> int:
        """From the timer to transmission, ns."""
        if self.execution_us is not None:
            return round(self.execution_us * 1e3)
        if self.name == PYTHON:
            return EXECUTION_NS
        cost = json.loads(COST.read_text())["processors"][self.name]
        return math.ceil(cost["worst_period_cycles"] * 1e3 / (self.clock_mhz or cost["clock_mhz"]))

    @property
    def text(self) -> str:
        """What `firmware_of_text` makes this firmware of."""
        figures = ((name, getattr(self, name)) for name in FIGURES)
        return ",".join([self.name, *(f"{name}={value}" for name, value in figures if value is not None)])

    def controller(self, contract: Contract, calibration_block: bytes) -> Controller:
        """Return a new controller node.

        Raises
        ------
        FirmwareError
            If the emulator is not installed.
        """
        if self.name == PYTHON:
            return Controller(contract, calibration_block, self.execution_ns)
        require_emulator(f"--firmware {self.name}")
        from firmware_py.emulated.image import reference_image
        from firmware_py.emulated.node import EmulatedController

        image = reference_image(self.name)
        return EmulatedController(contract, calibration_block, self.name, image, self.execution_ns)


def check_clock(clock_mhz: float) -> None:
    """Refuse a clock that no processor has.

    Raises
    ------
    FirmwareError
        If it is not from 1 to 1000 MHz.
    """
    if not 1.0 <= clock_mhz <= 1000.0:
        raise FirmwareError(f"a clock of {clock_mhz:g} MHz is not from 1 to 1000")


def require_emulator(what: str) -> None:
    """Make sure that the emulator can be had for `what` is asked.

    Raises
    ------
    FirmwareError
        If it is not installed.
    """
    if importlib.util.find_spec("unicorn") is None or importlib.util.find_spec("elftools") is None:
        raise FirmwareError(f"{what} needs the emulator: pip install '.[pil]' in the project's folder")


def firmware_of_text(text: str) -> ChosenFirmware:
    """Return a firmware given as ``cortex-m4,clock_mhz=168,execution_us=20``; figures may be left out.

    Raises
    ------
    FirmwareError
        If there is no such firmware or figure.
    """
    name, *given = text.split(",")
    figures = {}
    for item in given:
        key, _, value = item.partition("=")
        try:
            figures[FIGURES[FIGURES.index(key.strip())]] = float(value)
        except ValueError as error:
            known = ", ".join(f"{figure}=NUMBER" for figure in FIGURES)
            raise FirmwareError(f"firmware {name}: {item!r} is none of {known}") from error
    return ChosenFirmware(name.strip(), **figures)


def add_firmware_argument(parser: argparse.ArgumentParser) -> None:
    """Add --firmware; `firmware_of_text` makes it a firmware."""
    parser.add_argument("--firmware", default=PYTHON, metavar="NAME,K=V", help=" ".join(FIRMWARES))
