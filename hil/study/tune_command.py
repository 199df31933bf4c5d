"""``hil tune``: the command line of minimax tuning."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from firmware_py.tuning import TUNINGS
from hil.progress import progress_bar
from hil.run.options import BenchError, InterruptedRunError
from hil.run.stopping import StopFlag
from hil.scenario import controller_of
from hil.study.box import load_box

if TYPE_CHECKING:
    from hil.study.tune import Search


def add_command(commands: Any) -> None:
    """Add ``hil tune`` to the command line."""
    tune = commands.add_parser(
        "tune",
        help="make a tuning's worst errors over a box of machines small",
        usage="hil tune [options]",
        epilog="Ctrl-C keeps the best so far.\n"
        "exit codes: 0 written; 2 wrong input, or limits out of reach; 130 interrupted",
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=40),
    )
    tune.set_defaults(command=run_command)
    tune.add_argument(
        "--tuning",
        choices=TUNINGS,
        default="robust",
        metavar="START",
        help="gains to begin with, and the law (default robust)",
    )
    tune.add_argument("--samples", type=int, default=16, metavar="N", help="machines, half corners (16)")
    tune.add_argument("--seed", type=int, default=0, metavar="S", help="of machines and search (default 0)")
    tune.add_argument("--evaluations", type=int, default=100, metavar="M", help="candidates (default 100)")
    tune.add_argument(
        "--max-ms",
        type=float,
        default=2.0,
        metavar="MS",
        help="largest Ms allowed on the nominal machine (default 2)",
    )
    tune.add_argument("--box", type=Path, metavar="FILE", help="another box than hil/study/box.toml")
    tune.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    tune.add_argument(
        "--out", type=Path, metavar="FILE", help="block (default out/tuned.cal), .toml beside it"
    )


def run_command(arguments: argparse.Namespace) -> int:
    """Run ``hil tune`` and return the exit code."""
    from hil.study.runs import all_cores  # compiles the loop when it has changed
    from hil.study.tune import Search, SearchStoppedError, gains_toml, machines_of

    for name, least in (("samples", 2), ("seed", 0), ("evaluations", 1), ("workers", 1)):
        value = getattr(arguments, name)
        if value is not None and value < least:
            raise BenchError(f"--{name} is {value}, must be {least} or more")
    block_file = arguments.out or Path("out") / "tuned.cal"
    if block_file.suffix == ".toml":
        raise BenchError(f"--out is {block_file}: the block needs another suffix, its .toml goes beside it")
    machines = machines_of(load_box(arguments.box), arguments.samples, arguments.seed)
    stopped = StopFlag.on_signals()
    with (
        all_cores(arguments.workers) as executor,
        progress_bar("tune: the start", arguments.evaluations, "candidates") as show,
    ):

        def advance(search: "Search") -> None:
            shown = f"cost {search.best.cost:.3f}" if search.best.within_limits else "none within the limits"
            show(completed=search.evaluations, description=f"tune: {shown}")
            if stopped.is_set():
                raise SearchStoppedError

        search = Search(TUNINGS[arguments.tuning], machines, arguments.max_ms, executor)
        search.run(arguments.evaluations, arguments.seed, advance)
    about = (
        f"hil tune --tuning {arguments.tuning} --samples {arguments.samples} --seed {arguments.seed} "
        f"--evaluations {arguments.evaluations} --max-ms {arguments.max_ms:g}"
        + (f" --box {arguments.box}" if arguments.box else ""),
        f"{search.evaluations} candidates, cost {search.best.cost:.4f} (start {search.started.cost:.4f})",
    )
    gains_file = block_file.with_suffix(".toml")
    try:
        block_file.parent.mkdir(parents=True, exist_ok=True)
        block_file.write_bytes(search.best.tuning.calibration().to_bytes())
        gains_file.write_text(gains_toml(search.best.tuning, about), encoding="utf-8")
    except OSError as error:
        raise BenchError(f"cannot write {error.filename} ({error.strerror})") from error
    Console().print(_table(search))
    print(f"{block_file} and {gains_file}: hil run sine --calibration {block_file}")
    if stopped.is_set():
        raise InterruptedRunError(f"interrupted after {search.evaluations} candidates, the best is kept")
    return 0


def _table(search: "Search") -> Table:
    from hil.study.tune import SCENARIOS

    start, best = search.started, search.best
    table = Table(title=f"{controller_of(best.tuning.law)}, {search.evaluations} candidates")
    for heading in ("RMS error / mm", "start", "best"):
        table.add_column(heading, justify="left" if heading.startswith("RMS") else "right")
    for index, name in enumerate(SCENARIOS):
        for label, part in (("nominal", "nominal_mm"), ("worst", "worst_mm")):
            cells = (getattr(one, part) for one in (start, best))
            table.add_row(f"{name}, {label}", *("-" if c is None else f"{c[index]:.3f}" for c in cells))
    table.add_row("Ms", f"{start.ms:.2f}", f"{best.ms:.2f}")
    table.add_row("largest eigenvalue", f"{start.spectral_radius:.5f}", f"{best.spectral_radius:.5f}")
    return table
