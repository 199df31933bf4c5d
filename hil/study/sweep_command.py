"""``hil sweep``: the command line of sweeps."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from firmware_py.chosen_tuning import add_tuning_arguments, tuning_of
from hil.measure import METRICS
from hil.progress import progress_bar
from hil.report import ResultFolder
from hil.run.options import BenchError, InterruptedRunError
from hil.run.stopping import StopFlag
from hil.scenario import CONTROLLERS, controller_of, load_scenario
from hil.study.box import load_box

if TYPE_CHECKING:
    from hil.study.sweep import Sweep

DEFAULT_SAMPLES = 500
EXIT_OK, EXIT_FAILURES = range(2)


def add_command(commands: Any) -> None:
    """Add ``hil sweep`` to the command line."""
    sweep = commands.add_parser(
        "sweep",
        help="play scenarios on many machines of a box",
        usage="hil sweep SCENARIO... [options]   (names as in `hil list`, or .toml)",
        epilog="exit codes: 0 no more samples failed than may; 1 more; 2 wrong input or no\n"
        "answer; 3 a process was lost; 130 interrupted",
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=40),
    )
    sweep.set_defaults(command=run_command)
    sweep.add_argument("scenarios", nargs="+", help=argparse.SUPPRESS)
    design = sweep.add_mutually_exclusive_group()
    design.add_argument(
        "--samples", type=int, default=DEFAULT_SAMPLES, metavar="N", help=f"default {DEFAULT_SAMPLES}"
    )
    design.add_argument("--corners", action="store_true", help="the box's corners instead of samples")
    sweep.add_argument("--seed", type=int, default=0, metavar="S", help="of the samples (default 0)")
    sweep.add_argument("--box", type=Path, metavar="FILE", help="another box than hil/study/box.toml")
    sweep.add_argument("--controller", choices=CONTROLLERS, metavar="LAW", help="default: the tuning's own")
    add_tuning_arguments(sweep)
    sweep.add_argument("--duration", type=float, metavar="S", help="other length than the scenarios', s")
    sweep.add_argument(
        "--max-failures", type=int, default=0, metavar="N", help="samples that may fail (default 0)"
    )
    where = sweep.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    where.add_argument("--cluster", metavar="ADDRESS", help="a Dask scheduler's, instead of processes here")
    sweep.add_argument("--out", type=Path, metavar="DIR", help="result folder (default out/sweep-SCENARIO)")
    sweep.add_argument("--json", action="store_true", help="print sweep.json instead of a table")


def run_command(arguments: argparse.Namespace) -> int:
    """Run ``hil sweep`` and return the exit code."""
    from hil.study.runs import FAILED_RMS_MM, all_cores, dask_cluster, figures_of  # compiles a changed loop
    from hil.study.sweep import draw, write_samples

    sweep = _sweep_of(arguments)
    if arguments.workers is not None and arguments.workers < 1:
        raise BenchError(f"--workers is {arguments.workers}, must be 1 or more")
    if arguments.max_failures < 0:
        raise BenchError(f"--max-failures is {arguments.max_failures}, must be 0 or more")
    stopped = StopFlag.on_signals()
    out = arguments.out or Path("out") / f"sweep-{'-'.join(scenario.name for scenario in sweep.scenarios)}"
    pool = dask_cluster(arguments.cluster) if arguments.cluster else all_cores(arguments.workers)
    with ResultFolder(out) as folder:
        begin_s = time.perf_counter()
        with pool as executor, progress_bar("sweep", len(sweep.machines), sweep.kind) as show:

            def advance(done: int) -> None:
                if stopped.is_set():
                    raise InterruptedRunError(f"interrupted after {done} of {len(sweep.machines)} samples")
                show(completed=done)

            figures = figures_of(
                sweep.tuning.calibration,
                sweep.scenarios,
                sweep.machines,
                executor,
                law=sweep.law,
                progress=advance,
            )
        summary = sweep.summary(figures) | {"wall_s": time.perf_counter() - begin_s}
        text = json.dumps(summary, indent=2, allow_nan=False)
        made = [folder.scratch / name for name in ("sweep.json", "samples.csv", "picture.png")]
        made[0].write_text(text + "\n", encoding="utf-8")
        write_samples(made[1], sweep, figures)
        draw(made[2], sweep, figures, summary)
        folder.move_in(made)
    if arguments.json:
        print(text)
    else:
        Console().print(_table(summary))
        for entry in summary["failed"]:
            print(entry["replay"])
        print(f"{', '.join(file.name for file in made)} in {out}")
    if summary["failures"] <= arguments.max_failures:
        return EXIT_OK
    print(
        f"hil: {summary['failures']} of {summary['samples']} {sweep.kind} failed, RMS error above "
        f"{FAILED_RMS_MM:g} mm or no number; {arguments.max_failures} may (--max-failures)",
        file=sys.stderr,
    )
    return EXIT_FAILURES


def _sweep_of(arguments: argparse.Namespace) -> "Sweep":
    from hil.study.sweep import CORNERS, SAMPLES, Sweep

    scenarios = tuple(load_scenario(name, arguments.duration) for name in arguments.scenarios)
    tuning, box = tuning_of(arguments), load_box(arguments.box)
    base = scenarios[0].machine
    if any(scenario.machine != base for scenario in scenarios):
        raise BenchError("the scenarios are played on different machines: sweep them one at a time")
    if failing := [scenario.name for scenario in scenarios if scenario.faults]:
        raise BenchError(f"{failing[0]} has faults, which need the bus: a sweep is played without one")
    if arguments.samples < 1 or arguments.seed < 0:
        raise BenchError("--samples must be 1 or more, --seed 0 or more")
    machines = (
        box.corners(base) if arguments.corners else box.samples(arguments.samples, arguments.seed, base)
    )
    return Sweep(
        names=tuple(arguments.scenarios),
        scenarios=scenarios,
        duration_s=arguments.duration,
        tuning=tuning,
        controller=arguments.controller or controller_of(tuning.calibration.law),
        box=box,
        design=CORNERS if arguments.corners else SAMPLES,
        seed=None if arguments.corners else arguments.seed,
        machines=tuple(machines),
    )


def _table(summary: dict[str, Any]) -> Table:
    table = Table(
        title=f"{', '.join(summary['scenarios'])}, {summary['tuning']} ({summary['controller']}), "
        f"{summary['samples']} {'corners' if summary['seed'] is None else 'samples'}"
    )
    for heading in ("", "median", "95 % interval", "95th percentile", "worst"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, (label, decimals) in METRICS.items():
        spread, form = summary[name], f".{decimals}f"
        between = _interval(spread["median_low"], spread["median_high"], form)
        median, p95, worst = (_number(spread[key], form) for key in ("median", "p95", "worst"))
        table.add_row(label, median, between, p95, worst)
    share = summary["failure_share"]
    between = _interval(share["low"], share["high"], ".1%")
    table.add_row(f"failures: {summary['failures']}", f"{share['value']:.1%}", between, "", "")
    table.add_row("wall time / s", f"{summary['wall_s']:.1f}", "", "", "")
    return table


def _interval(low: float | None, high: float | None, form: str) -> str:
    return "" if low is None or high is None else f"{low:{form}} to {high:{form}}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
