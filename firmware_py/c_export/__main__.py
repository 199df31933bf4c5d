"""``python -m firmware_py.c_export DIR``: write the firmware as C99."""

import argparse
import sys
from pathlib import Path

from dbc.contract import Contract, ContractError
from firmware_py.c_export.expressions import ExportError
from firmware_py.c_export.files import export
from firmware_py.calibration import CalibrationError
from firmware_py.chosen_tuning import add_tuning_arguments, tuning_of

DESCRIPTION = "Write the firmware as dependency-free C99: ddh_controller.h, .c and ddh_calibration.c."


def main(argv: list[str] | None = None) -> int:
    """Write the files."""
    parser = argparse.ArgumentParser(prog="python -m firmware_py.c_export", description=DESCRIPTION)
    parser.add_argument("directory", type=Path, metavar="DIR", help="where to; it is created if need be")
    add_tuning_arguments(parser)
    parser.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the packaged ddh.dbc")
    arguments = parser.parse_args(argv)
    try:
        files = export(tuning_of(arguments), Contract.load(arguments.dbc))
        arguments.directory.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (arguments.directory / name).write_text(text, encoding="utf-8")
    except (CalibrationError, ContractError, ExportError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"{parser.prog}: cannot write to {arguments.directory} ({error.strerror})", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
