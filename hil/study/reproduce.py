"""``hil reproduce``: the paper's evaluation over the bus, as one report."""

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from hil.progress import progress_bars
from hil.report import ResultFolder
from hil.run.options import INTERRUPTED, InterruptedRunError
from hil.run.stopping import StopFlag
from hil.study import paper

if TYPE_CHECKING:
    from hil.study.evaluation import Contestant, Evaluation

DEFAULT_OUT = Path("out/reproduce")
_POLL_S = 0.1


def add_command(commands: Any) -> None:
    """Add ``reproduce`` to the command line."""
    reproduce = commands.add_parser(
        "reproduce",
        help="play the paper's evaluation and write a report",
        epilog="exit codes: 0 written; 2 wrong input; 3 a process was lost; 130 interrupted",
    )
    reproduce.set_defaults(command=_reproduce)
    reproduce.add_argument(
        "--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help=f"result folder (default {DEFAULT_OUT})"
    )
    reproduce.add_argument("--json", action="store_true", help="print tables.json instead of a table")


def evaluate(
    folder: Path,
    scenarios: Sequence[str],
    taking_part: Sequence["Contestant"],
    cores: Executor,
    stopped: StopFlag,
    progress: Progress,
) -> tuple[dict[str, Any], list[Path]]:
    """Play, sweep, analyse and draw everything.

    Parameters
    ----------
    folder : Path
        Where the files are made.
    scenarios : sequence of str
        Some of `hil.study.paper.CASES`.
    taking_part : sequence of Contestant
        The paper's three, and others.
    cores : Executor
        Where to run; its number of workers has no part in the result.
    stopped : StopFlag
        Ends it early.
    progress : rich.progress.Progress
        From `hil.progress.progress_bars`; shows how far it is.

    Returns
    -------
    tables : dict
        The content of ``tables.json``.
    made : list of Path
        The files.
    """
    from hil.study.evaluation import Evaluation, play, stability_of, tables_of
    from hil.study.linear import OPERATING_POINTS
    from hil.study.report_page import page
    from hil.study.state_space import validate

    pairs = [(name, one) for name in scenarios for one in taking_part]
    runs = _all(cores, [partial(play, pair) for pair in pairs], stopped, progress, "playing", "runs")
    analyses: list[Callable[[], Any]] = [
        partial(stability_of, taking_part, point) for point in OPERATING_POINTS
    ]
    validation, *stability = _all(cores, [validate, *analyses], stopped, progress, "analysing", "analyses")
    evaluation = Evaluation(
        taking_part=taking_part,
        scenarios=scenarios,
        runs={(name, one.label): run for (name, one), run in zip(pairs, runs, strict=True)},
        swept=_swept(taking_part, cores, stopped, progress),
        stability=dict(zip(OPERATING_POINTS, stability, strict=True)),
        validation=validation,
    )
    tables = tables_of(evaluation)
    drawn = _all(cores, _drawings(folder, evaluation, tables), stopped, progress, "drawing", "pictures")
    pictures = [path for paths in drawn for path in paths]
    made = [folder / "tables.json", folder / "report.html"]
    made[0].write_text(_json(tables), encoding="utf-8")
    svg = {path.stem: path for path in pictures if path.suffix == ".svg"}
    made[1].write_text(page(tables, svg), encoding="utf-8")
    return tables, made + pictures


def _swept(
    taking_part: Sequence["Contestant"], cores: Executor, stopped: StopFlag, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Return what comes of each contestant's sweep, by label."""
    from hil.study.evaluation import sweep_of
    from hil.study.runs import figures_of

    sweeps = {one.label: sweep_of(one) for one in taking_part}
    bar = progress.add_task(
        "sweeping", total=sum(len(sweep.machines) for sweep in sweeps.values()), unit="machines"
    )
    swept, done = {}, 0

    def advance(machines: int) -> None:
        progress.update(bar, completed=done + machines)
        if stopped.is_set():
            raise InterruptedRunError(INTERRUPTED)

    for label, sweep in sweeps.items():
        figures = figures_of(
            sweep.tuning.calibration, sweep.scenarios, sweep.machines, cores, law=sweep.law, progress=advance
        )
        swept[label] = sweep.summary(figures)
        done += len(sweep.machines)
    return swept


def _drawings(
    folder: Path, evaluation: "Evaluation", tables: dict[str, Any]
) -> list[Callable[[], list[Path]]]:
    """Return what draws each picture, the slowest first."""
    from hil.study import figures
    from hil.study.stability import heat_map
    from hil.study.state_space import figure_3b

    traces = {name: evaluation.traces(name) for name in evaluation.scenarios}
    papers = [one.label for one in evaluation.taking_part if one.in_paper]
    pictures: list[tuple[str, Callable[..., figures.Draw], tuple[Any, ...]]] = [
        ("stability", heat_map, (evaluation.stability[figures.MAPPED_POINT].maps,)),
        *(
            (
                f"figure_{paper.CASES[name].figure}",
                figures.tracking,
                ({label: by_label[label] for label in papers},),
            )
            for name, by_label in traces.items()
        ),
        ("figure_3b", figure_3b, (evaluation.validation,)),
        ("rivals", figures.rivals, (traces,)),
        ("comparison", figures.comparison, (tables,)),
    ]
    return [partial(_draw, folder, *picture) for picture in pictures]


def _draw(folder: Path, name: str, drawer: Callable[..., Any], content: Sequence[Any]) -> list[Path]:
    from hil.study.figures import save

    return save(folder, name, drawer(*content))


def _all(
    cores: Executor,
    tasks: Sequence[Callable[[], Any]],
    stopped: StopFlag,
    progress: Progress,
    what: str,
    unit: str,
) -> list[Any]:
    """Return what the tasks return, in their order; show how far they are and stop when asked to."""
    bar = progress.add_task(what, total=len(tasks), unit=unit)
    futures = [cores.submit(task) for task in tasks]
    pending: set[Future[Any]] = set(futures)
    while pending:
        finished, pending = wait(pending, _POLL_S, FIRST_COMPLETED)
        for future in finished:
            future.result()
            progress.advance(bar)
        if stopped.is_set():
            raise InterruptedRunError(INTERRUPTED)
    return [future.result() for future in futures]


def _reproduce(arguments: argparse.Namespace) -> int:
    from hil.study.evaluation import contestants  # compiles what has changed
    from hil.study.runs import all_cores

    stopped = StopFlag.on_signals()
    with (
        ResultFolder(arguments.out) as folder,
        all_cores() as cores,
        progress_bars() as progress,
    ):
        tables, made = evaluate(folder.scratch, list(paper.CASES), contestants(), cores, stopped, progress)
        folder.move_in(made)
    if arguments.json:
        print(_json(tables), end="")
    else:
        Console().print(summary(tables))
        print(f"report.html, tables.json and {len(made) - 2} pictures in {arguments.out}")
    return 0


def _json(tables: dict[str, Any]) -> str:
    return json.dumps(tables, indent=1, ensure_ascii=False) + "\n"


def summary(tables: dict[str, Any]) -> Table:
    """Return the errors as a table for the screen."""
    table = Table(title="RMS / maximum error, mm", box=None)
    table.add_column("")
    for name in tables["scenarios"]:
        table.add_column(name, justify="right")

    def add(label: str, figures: Iterable[dict[str, float]]) -> None:
        table.add_row(label, *(f"{cell['rms_mm']:.3f} / {cell['max_mm']:.3f}" for cell in figures))

    for label, contestant in tables["contestants"].items():
        if contestant["in_paper"]:
            law = contestant["law"]
            add(f"{label}, paper", (scenario["paper"][law] for scenario in tables["scenarios"].values()))
        add(label, (scenario["ours"][label] for scenario in tables["scenarios"].values()))
    return table
