"""How far a command is: one form of progress bar for all of them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def progress_bars() -> Progress:
    """Return bars on standard error that vanish when they are done; none where that is no terminal.

    Each task has a field ``unit``: what is counted.
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def progress_bar(what: str, total: float, unit: str) -> Iterator[Callable[..., None]]:
    """Show one bar; what is yielded takes ``completed``, and ``description`` to show instead of `what`."""
    with progress_bars() as bars:
        yield partial(bars.update, bars.add_task(what, total=total, unit=unit))
