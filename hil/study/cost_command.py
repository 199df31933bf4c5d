"""``hil cost``: what the firmware costs on its processors."""

import argparse
import json
import sys
from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter
from typing import Any

from rich.console import Console
from rich.table import Table

from dbc.node import PERIOD_NS
from firmware_py.chosen_firmware import COST, check_clock, require_emulator
from hil.run.options import BenchError

DESCRIPTION = """Instructions are counted in an emulator and exact. Cycles are an estimate from the reference
manuals (of rv32imc: for a Hazard3, the RISC-V core of the RP2350), a range, with zero wait states; worst is
the worst seen, not a bound."""

MOST_PERIODS = 10_000
"""Control periods of the sine."""

_WIDTH = 140


def add_command(commands: Any) -> None:
    """Add ``cost`` to the command line."""
    parser = commands.add_parser(
        "cost", help="what the firmware costs on its processors", description=DESCRIPTION
    )
    parser.set_defaults(command=cost)
    parser.add_argument("--measure", action="store_true", help="measure instead of showing what was measured")
    parser.add_argument(
        "--write",
        action="store_true",
        help="measure, and keep it as the figures to compare with; needs zig and gcc",
    )
    parser.add_argument(
        "--periods", type=int, default=MOST_PERIODS, metavar="N", help="to measure of the sine (10000, all)"
    )
    parser.add_argument(
        "--clock-mhz", type=float, metavar="F", help="clock in MHz for the share of the period"
    )
    parser.add_argument("--json", action="store_true", help="print all figures")


def cost(arguments: argparse.Namespace) -> int:
    """Show the bill."""
    if not 1 <= arguments.periods <= MOST_PERIODS:
        raise BenchError(f"--periods is {arguments.periods}, must be from 1 to {MOST_PERIODS}")
    if arguments.periods != MOST_PERIODS and not (arguments.measure or arguments.write):
        raise BenchError("--periods needs --measure: what was measured is of all periods")
    if arguments.clock_mhz is not None:
        check_clock(arguments.clock_mhz)
    if arguments.measure or arguments.write:
        require_emulator("hil cost --measure")
        from firmware_py.emulated.build import BuildError
        from hil.study.cost import bill, compiler_names, compilers_bill

        def progress(what: str) -> None:
            print(f"hil: {what}", file=sys.stderr)

        try:
            names = compiler_names() if arguments.write else {}
            figures = bill(arguments.periods, progress)
            if arguments.write:
                figures["compilers"] = compilers_bill(names, arguments.periods, progress)
                COST.write_text(json.dumps(figures, indent=1) + "\n")
        except BuildError as error:
            raise BenchError(str(error)) from error
    else:
        figures = json.loads(COST.read_text())
    if arguments.json:
        print(json.dumps(figures, indent=1))
    else:
        console = Console(width=max(Console().width, _WIDTH))
        console.print(f"{figures['compiler']}; cycles are an estimate, of rv32imc for a Hazard3")
        console.print(*_tables(figures, arguments.clock_mhz), sep="\n")
    return 0


def rows(figures: dict[str, Any], clock_mhz: float | None = None) -> list[tuple[str, ...]]:
    """Return the bill as rows of text: processor, controller, then the figures under `HEADINGS`."""
    table: list[tuple[str, ...]] = []
    for processor, one in figures["processors"].items():
        clock = clock_mhz or one["clock_mhz"]
        cycles = clock * PERIOD_NS * 1e-3
        for controller, bill in one["controllers"].items():
            step, timer = bill["step"], bill["timer"]
            worst = max((step[name]["worst_cycles"] for name in step), key=lambda cycles: cycles[1])
            period = max((timer[name]["worst_cycles"] for name in timer), key=lambda cycles: cycles[1])
            table.append(
                (
                    f"{processor}, {clock:g} MHz",
                    controller,
                    f"{step['sine']['mean_instructions']:.0f}",
                    f"{step['sine']['worst_instructions']}",
                    f"{step['jumps']['worst_instructions']}",
                    "{}-{}".format(*step["sine"]["worst_cycles"]),
                    "{}-{}".format(*worst),
                    f"{100 * worst[1] / cycles:.2f}",
                    f"{timer['sine']['mean_instructions']:.0f}",
                    "{}-{}".format(*period),
                    f"{100 * period[1] / cycles:.2f}",
                )
            )
    return table


HEADINGS = (
    "processor",
    "law",
    "law: instructions, mean of the sine",
    "law: instructions, worst of the sine",
    "law: instructions, worst of jumps",
    "law: cycles, worst of the sine",
    "law: cycles, worst seen",
    "law: % of 1 ms",
    "period: instructions, mean of the sine",
    "period: cycles, worst seen",
    "period: % of 1 ms",
)
"""Of the law alone, and of a whole control period with its interrupts."""


def _tables(figures: dict[str, Any], clock_mhz: float | None) -> Iterator[Table]:
    for processor, bill in groupby(rows(figures, clock_mhz), key=itemgetter(0)):
        table = Table(title=processor)
        columns = list(zip(*bill, strict=True))[1:]
        for number, (heading, column) in enumerate(zip(HEADINGS[1:], columns, strict=True)):
            longest = max(len(word) for word in " ".join((heading, *column)).split())  # a figure is never cut
            table.add_column(heading, justify="right" if number else "left", width=longest)
        for row in zip(*columns, strict=True):
            table.add_row(*row)
        yield table
