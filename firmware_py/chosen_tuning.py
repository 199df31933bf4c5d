"""Host side: what the firmware is calibrated with, a built-in tuning by name or a file."""

import argparse
from dataclasses import dataclass
from pathlib import Path

from firmware_py.calibration import Calibration, CalibrationError
from firmware_py.tuning import TUNINGS

DEFAULT_TUNING = "robust"


@dataclass(frozen=True, slots=True)
class ChosenTuning:
    """A calibration block, and what it was chosen by.

    Attributes
    ----------
    name : str
        Of the tuning, or of the file.
    calibration : Calibration
        The block.
    is_file : bool
        Whether `name` is a file's.
    """

    name: str
    calibration: Calibration
    is_file: bool = False


def chosen_tuning(name: str | None = None, file: Path | None = None) -> ChosenTuning:
    """Return a built-in tuning, or what a file holds; without either, the default tuning.

    Raises
    ------
    CalibrationError
        If there is no tuning of that name, or the file holds no calibration block; one line.
    """
    if file is None:
        name = name or DEFAULT_TUNING
        if name not in TUNINGS:
            raise CalibrationError(f"there is no tuning {name!r}: choose one of {', '.join(TUNINGS)}")
        return ChosenTuning(name, TUNINGS[name].calibration())
    if name is not None:
        raise CalibrationError("a tuning and a calibration file exclude each other: give one")
    try:
        return ChosenTuning(str(file), Calibration.from_bytes(file.read_bytes()), is_file=True)
    except OSError as error:
        raise CalibrationError(f"cannot read calibration file {file} ({error.strerror})") from error
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def add_tuning_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --tuning and --calibration; `tuning_of` makes them a tuning."""
    parser.add_argument(
        "--tuning",
        metavar="NAME",
        help=f"one of `hil list` (default {DEFAULT_TUNING})",
    )
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="calibration block instead")


def tuning_of(arguments: argparse.Namespace) -> ChosenTuning:
    """Return what --tuning or --calibration chose; raises as `chosen_tuning` does."""
    return chosen_tuning(arguments.tuning, arguments.calibration)
