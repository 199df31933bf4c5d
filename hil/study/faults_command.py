"""``hil faults``: every fault in every phase, measured and compared with what is expected."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from firmware_py.chosen_tuning import add_tuning_arguments, tuning_of
from hil.faults.catalogue import KINDS
from hil.progress import progress_bar
from hil.report import ResultFolder
from hil.run.options import BenchError, InterruptedRunError
from hil.run.stopping import StopFlag
from hil.study.fault_matrix import PHASES, Case, MatrixError, load_matrix

if TYPE_CHECKING:
    from hil.study.fault_runs import Played

DEFAULT_OUT = Path("out/faults")
EXIT_OK, EXIT_UNEXPECTED = 0, 1


def add_command(commands: Any) -> None:
    """Add ``hil faults`` to the command line."""
    faults = commands.add_parser(
        "faults",
        help="play every fault in every phase and compare with the expected reactions",
        epilog="exit codes: 0 all as expected; 1 not; 2 wrong input; 3 a process was lost; 130 interrupted",
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=40),
    )
    faults.set_defaults(command=run_command)
    faults.add_argument(
        "--fault", action="append", choices=KINDS, metavar="KIND", help="only these; may be repeated"
    )
    faults.add_argument(
        "--phase", action="append", choices=PHASES, metavar="P", help=f"only some of {', '.join(PHASES)}"
    )
    faults.add_argument("--matrix", type=Path, metavar="FILE", help="other expectations, TOML")
    add_tuning_arguments(faults)
    faults.add_argument("--jobs", type=int, metavar="N", help="processes (default: one per core)")
    faults.add_argument(
        "--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help=f"result folder (default {DEFAULT_OUT})"
    )
    faults.add_argument("--json", action="store_true", help="print matrix.json instead of a table")


def run_command(arguments: argparse.Namespace) -> int:
    """Run ``hil faults`` and return the exit code."""
    from hil.study.fault_pages import draw, page  # compiles the bench when it has changed
    from hil.study.fault_runs import matrix_of, play_matrix
    from hil.study.runs import all_cores

    cases, tuning = _cases(arguments), tuning_of(arguments)
    if arguments.jobs is not None and arguments.jobs < 1:
        raise BenchError(f"--jobs is {arguments.jobs}, must be 1 or more")
    stopped = StopFlag.on_signals()
    with ResultFolder(arguments.out) as folder:
        with all_cores(arguments.jobs) as executor, progress_bar("faults", len(cases), "cases") as show:

            def advance(done: int) -> None:
                if stopped.is_set():
                    raise InterruptedRunError(f"interrupted after {done} of {len(cases)} cases")
                show(completed=done)

            played = play_matrix(cases, tuning, executor, advance)
        matrix = matrix_of(played, tuning)
        text = json.dumps(matrix, indent=2, allow_nan=False)
        made = [folder.scratch / name for name in ("matrix.json", "report.html")]
        made[0].write_text(text + "\n", encoding="utf-8")
        pictures = {}
        if drawn := [one for one in played if one.course]:
            pictures["courses"] = folder.scratch / "courses.svg"
            draw(pictures["courses"], drawn)
        made[1].write_text(page(matrix, pictures), encoding="utf-8")
        made += pictures.values()
        folder.move_in(made)
    if arguments.json:
        print(text)
    else:
        _print(matrix, played)
        print(f"{', '.join(file.name for file in made)} in {arguments.out}")
    return EXIT_UNEXPECTED if any(one.complaints for one in played) else EXIT_OK


def _cases(arguments: argparse.Namespace) -> list[Case]:
    try:
        text = arguments.matrix.read_text(encoding="utf-8") if arguments.matrix else None
    except (OSError, UnicodeDecodeError) as error:
        raise BenchError(f"cannot read the matrix {arguments.matrix}: {error}") from error
    kinds, phases = arguments.fault or KINDS, arguments.phase or PHASES
    try:
        matrix = load_matrix(text)
    except MatrixError as error:
        raise MatrixError(f"{arguments.matrix}: {error}") from error
    cases = [case for case in matrix if case.fault.kind in kinds and case.phase in phases]
    if not cases:
        raise BenchError("the matrix has no such case")
    return cases


def _print(matrix: dict[str, Any], played: "Sequence[Played]") -> None:
    from hil.study.fault_pages import grouped, noticed, reaction

    unexpected = [one for one in played if one.complaints]
    table = Table(title=f"{len(played)} cases under {matrix['tuning']}, {len(unexpected)} not as expected")
    table.add_column("fault", overflow="fold", min_width=26)  # all four fit into 80 columns
    table.add_column("noticed by", max_width=15)
    table.add_column("reaction", max_width=15)
    table.add_column("as expected", justify="right")
    for faults in grouped(matrix).values():
        for name, cases in faults.items():
            good = sum(case["as_expected"] for case in cases)
            table.add_row(name.replace(",", ", "), noticed(cases), reaction(cases), f"{good} of {len(cases)}")
        table.add_section()
    Console().print(table)
    for one in unexpected:
        print(f"{one.case.name} in {one.case.phase}: {'; '.join(one.complaints)}")
