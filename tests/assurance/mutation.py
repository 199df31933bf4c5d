"""Mutation testing of the modules in assurance.toml: `make mutation`.

Every mutant runs interpreted (NUMBA_DISABLE_JIT=1) in a forked process against the tests that reach it, until
one fails. A change within a function replaces that function's code in a process in which all tests are
collected; a change of what runs at import (tables, layouts) imports everything anew. Fails if the score is
below the limit, if a survivor is not argued in survivors.toml, or if one that is argued does not survive.

Why own code: mutmut and cosmic-ray change files on disk, or wrap each function in a trampoline that numba
cannot compile and an int32 array's view cannot pass; both leave module-level tables alone or pay an import
and a collection (1.5 s) for each of 2000 mutants.
"""

import argparse
import gc
import importlib.machinery
import importlib.util
import json
import os
import signal
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any

# third-party packages are imported once, before any fork; our own not before they are mutated
import can  # noqa: F401
import cantools  # noqa: F401
import hypothesis
import numba.extending  # noqa: F401
import numpy as np  # noqa: F401
import pytest
import scipy.optimize  # noqa: F401
from _pytest.runner import runtestprotocol
from groups import ENVIRONMENT, HERE, ROOT, Group, read_groups
from hypothesis import Phase
from mutators import Mutant, mutants
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

SURVIVORS = HERE / "survivors.toml"
PAGE = ROOT / "docs" / "testing.md"
BEGIN, END = "<!-- mutation: begin -->\n", "<!-- mutation: end -->\n"
SCORE_LIMIT_PERCENT = 95.0
FIRST_FAILURE = ("-x", "--tb=native")
KILLED, SURVIVED = 1, 0

Key = tuple[str, str, str, str]


def read_survivors() -> dict[Key, str]:
    """Return the reason of each argued survivor by its key."""
    return {
        (argument["file"], *mutant): argument["reason"]
        for argument in tomllib.loads(SURVIVORS.read_text()).get("argument", [])
        for mutant in argument["mutants"]
    }


def to_argue(survivors: Sequence[Mutant]) -> str:
    """Return entries for survivors.toml whose reason is still to be given."""
    text = ""
    for file in dict.fromkeys(mutant.file for mutant in survivors):
        keys = [mutant.key[1:] for mutant in survivors if mutant.file == file]
        lines = "".join(f"    {json.dumps(key)},\n" for key in keys)
        text += f'[[argument]]\nfile = "{file}"\nreason = ""\nmutants = [\n{lines}]\n\n'
    return text


@dataclass(frozen=True, slots=True)
class Reached:
    """What a test of the unchanged code called, and how long it took."""

    node_id: str
    functions: frozenset[tuple[str, str]]
    cpu_s: float


class Deterministic:
    """Hypothesis in every test: the same examples each time, found failures not shrunk."""

    def pytest_collectstart(self, collector: Any) -> None:
        profile = hypothesis.settings(
            derandomize=True,
            database=None,
            deadline=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        hypothesis.settings.register_profile("mutation", profile)
        hypothesis.settings.load_profile("mutation")


class Server(Deterministic):
    """In place of pytest's loop: all tests once, then each mutant of a function in a fork."""

    def __init__(self, todo: Sequence[Mutant], jobs: int, told: Callable[[int, int], None]) -> None:
        self._todo = todo
        self._jobs = jobs
        self._told = told
        self.reached: list[Reached] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: Any) -> bool:
        files = {str(ROOT / mutant.file): mutant.file for mutant in self._todo}
        for item, next_item in zip(session.items, [*session.items[1:], None], strict=True):
            self.reached.append(self._reach(item, next_item, files))
        functions = _functions(files)
        items = dict(zip((item.nodeid for item in session.items), session.items, strict=True))

        def run(mutant: Mutant) -> int:
            filename = str(ROOT / mutant.file)
            code = _code_of(mutant.compile(filename), mutant.scope)
            for function in functions.get((mutant.file, mutant.scope), ()):
                function.__code__ = code
            chosen = self._reaching(mutant)
            return _run_tests(chosen, items)

        for_each(self._todo, run, self._jobs, self._told)
        return True

    def _reach(self, item: Any, next_item: Any, files: dict[str, str]) -> Reached:
        called: set[tuple[str, str]] = set()

        def note(frame: Any, event: str, argument: Any) -> None:
            if file := files.get(frame.f_code.co_filename):
                called.add((file, frame.f_code.co_qualname.partition(".<locals>")[0]))

        begin = time.process_time()
        sys.settrace(note)
        try:
            reports = runtestprotocol(item, log=False, nextitem=next_item)
        finally:
            sys.settrace(None)
        for report in reports:
            if report.failed:
                raise SystemExit(f"{item.nodeid} fails on the unchanged code:\n{report.longreprtext}")
        return Reached(item.nodeid, frozenset(called), time.process_time() - begin)

    def _reaching(self, mutant: Mutant) -> list[Reached]:
        tests = [test for test in self.reached if (mutant.file, mutant.scope) in test.functions]
        return sorted(tests, key=lambda test: test.cpu_s)


class CheapestFirst(Deterministic):
    """A change is mostly noticed by the cheapest tests already."""

    def __init__(self, cost_s: dict[str, float]) -> None:
        self._cost_s = cost_s

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items.sort(key=lambda item: self._cost_s.get(item.nodeid, 0.0))


def _functions(files: dict[str, str]) -> dict[tuple[str, str], list[FunctionType]]:
    """All living functions of the targets, however they were loaded, by file and qualified name."""
    found: dict[tuple[str, str], list[FunctionType]] = {}
    for thing in gc.get_objects():
        if type(thing) is FunctionType and (file := files.get(thing.__code__.co_filename)):
            found.setdefault((file, thing.__code__.co_qualname), []).append(thing)
    return found


def _code_of(module: CodeType, qualname: str) -> CodeType:
    """The code of a function within its module's."""
    pending = [module]
    while pending:
        code = pending.pop()
        if code.co_qualname == qualname:
            return code
        pending += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    raise LookupError(qualname)


def _run_tests(tests: Sequence[Reached], items: dict[str, Any]) -> int:
    for test, next_test in zip(tests, [*tests[1:], None], strict=True):
        _limit_cpu(1.0 + 10.0 * test.cpu_s)
        next_item = items[next_test.node_id] if next_test else None
        if any(
            report.failed for report in runtestprotocol(items[test.node_id], log=False, nextitem=next_item)
        ):
            return KILLED
    return SURVIVED


def _limit_cpu(seconds: float) -> None:
    """End this process after so much CPU time: an endless loop is noticed, whatever else the machine does."""
    signal.signal(signal.SIGVTALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)


class ChangedModule(importlib.machinery.SourceFileLoader):
    """Finder and loader of one module whose code is a mutant's."""

    def __init__(self, file: str, code: CodeType) -> None:
        super().__init__(file.removesuffix(".py").replace("/", "."), str(ROOT / file))
        self._code = code

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def get_code(self, name: str) -> CodeType:
        return self._code


def run_at_import(group: Group, reached: list[Reached]) -> Callable[[Mutant], int]:
    """Return what runs a mutant of code that runs at import: it imports everything anew, file by file."""
    of_file = {name: [test for test in reached if test.node_id.startswith(name)] for name in group.tests}

    cheapest_first = CheapestFirst({test.node_id: test.cpu_s for test in reached})

    def run(mutant: Mutant) -> int:
        directory = os.path.dirname(mutant.file)

        def rank(name: str) -> tuple[bool, bool, float]:
            files = {file for test in of_file[name] for file, _ in test.functions}
            near = any(os.path.dirname(file) == directory for file in files)
            return mutant.file not in files, not near, sum(test.cpu_s for test in of_file[name])

        sys.meta_path.insert(0, ChangedModule(mutant.file, mutant.compile(str(ROOT / mutant.file))))  # type: ignore[arg-type]
        for name in sorted(group.tests, key=rank):
            _limit_cpu(5.0 + 5.0 * sum(test.cpu_s for test in of_file[name]))
            if pytest.main([*FIRST_FAILURE, *group.options, name], plugins=[cheapest_first]) != 0:
                return KILLED
        return SURVIVED

    return run


def for_each(
    todo: Sequence[Mutant], run: Callable[[Mutant], int], jobs: int, told: Callable[[int, int], None]
) -> None:
    """Run each mutant in a fork, `jobs` at a time; `told` gets its index and what became of it."""
    running: dict[int, int] = {}
    for index, mutant in enumerate(todo):
        pid = os.fork()
        if pid == 0:
            _silently(lambda mutant=mutant: run(mutant))
        running[pid] = index
        while len(running) >= jobs or (running and index == len(todo) - 1):
            pid, status = os.wait()
            told(running.pop(pid), SURVIVED if status == 0 else KILLED)


def _silently(work: Callable[[], int]) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    try:
        code = int(work())
    except BaseException:
        code = KILLED
    os._exit(code)


def run_within(
    todo: Sequence[Mutant], group: Group, jobs: int, told: Callable[[int, int], None]
) -> list[Reached]:
    """Run the mutants of functions; return what the tests reach."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        with os.fdopen(writer, "w", buffering=1) as pipe:
            server = Server(todo, jobs, lambda *outcome: print(json.dumps(outcome), file=pipe))
            code = int(pytest.main([*FIRST_FAILURE, *group.options, *group.tests], plugins=[server]))
            print(json.dumps([[t.node_id, sorted(t.functions), t.cpu_s] for t in server.reached]), file=pipe)
        os._exit(code)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        for line in pipe:
            last = json.loads(line)
            if isinstance(last[0], int):
                told(*last)
    if os.waitpid(pid, 0)[1]:
        raise SystemExit("the tests have to pass interpreted, without any mutant")
    return [Reached(node_id, frozenset(map(tuple, functions)), cpu_s) for node_id, functions, cpu_s in last]


def survivors_of(
    chosen: Sequence[Mutant], group: Group, jobs: int, progress: Progress, task: TaskID
) -> list[Mutant]:
    """Run the mutants; return those that no test noticed."""
    within = [mutant for mutant in chosen if mutant.scope]
    at_import = [mutant for mutant in chosen if not mutant.scope]
    survivors: list[Mutant] = []

    def tell(todo: list[Mutant]) -> Callable[[int, int], None]:
        def told(index: int, outcome: int) -> None:
            if outcome == SURVIVED:
                survivors.append(todo[index])
                progress.console.print(f"survives: {todo[index].where}: {todo[index].change}", markup=False)
            progress.advance(task)

        return told

    reached = run_within(within, group, jobs, tell(within))
    for_each(at_import, run_at_import(group, reached), jobs, tell(at_import))
    return sorted(survivors, key=lambda mutant: (mutant.file, mutant.line_number))


def table(chosen: Sequence[Mutant], survivors: Sequence[Mutant]) -> str:
    """Return the score of each file as a Markdown table."""
    total, alive = (Counter(mutant.file for mutant in some) for some in (chosen, survivors))
    rows = ["| file | mutants | killed | score |", "|---|---:|---:|---:|"]
    for name, count, left in [
        *((f, total[f], alive[f]) for f in total),
        ("all", len(chosen), len(survivors)),
    ]:
        rows.append(f"| {name} | {count} | {count - left} | {score_percent(count, left):.1f} % |")
    return "\n".join(rows) + "\n"


def score_percent(count: int, left: int) -> float:
    """Share of the mutants that were killed."""
    return 100.0 * (count - left) / count if count else 100.0


def complaints(
    chosen: Sequence[Mutant], survivors: Sequence[Mutant], argued: dict[Key, str], complete: bool
) -> Iterable[str]:
    """What is wrong with the outcome, a line each; a run that is not `complete` has no score."""
    score = score_percent(len(chosen), len(survivors))
    if complete and score < SCORE_LIMIT_PERCENT:
        yield f"score {score:.1f} % is below {SCORE_LIMIT_PERCENT} %"
    alive = {mutant.key for mutant in survivors}
    for mutant in survivors:
        if not argued.get(mutant.key, "").strip():
            yield f"survives without an argument: {mutant.where}: {mutant.change}"
    known = {mutant.key for mutant in chosen}
    for key in argued:
        if key not in alive and (complete or key in known):
            yield f"survivors.toml argues what does not survive: {key[0]} in {key[1] or 'module'}: {key[3]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 if all is well, 1 if not."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--only", metavar="TEXT", default="", help="files whose path contains TEXT")
    parser.add_argument("--line", metavar="TEXT", default="", help="source lines that contain TEXT")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at a time")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    if any(os.environ.get(name) != value for name, value in ENVIRONMENT.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ENVIRONMENT)
    os.chdir(ROOT)
    todo = {
        group: [
            mutant
            for target in group.targets
            if options.only in target
            for mutant in mutants(target, (ROOT / target).read_text())
            if options.line in mutant.line
        ]
        for group in read_groups()
    }
    chosen = [mutant for group in todo.values() for mutant in group]
    if not chosen:
        known = ", ".join(target for group in todo for target in group.targets)
        parser.error(f"no such mutant; the targets: {known}")
    begin = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("mutants", total=len(chosen))
        survivors = [
            survivor
            for group, mutants_of in todo.items()
            if mutants_of
            for survivor in survivors_of(mutants_of, group, options.jobs, progress, task)
        ]
    print(table(chosen, survivors))
    print(f"{time.monotonic() - begin:.0f} s, {options.jobs} at a time")
    argued = read_survivors()
    complete = not options.only and not options.line
    wrong = list(complaints(chosen, survivors, argued, complete))
    print(to_argue([mutant for mutant in survivors if mutant.key not in argued]))
    if complete:
        wrong += page_complaints(table(chosen, survivors), options.write)
    for complaint in wrong:
        print(complaint, file=sys.stderr)
    return 1 if wrong else 0


def page_complaints(measured: str, write: bool) -> list[str]:
    """Compare the page's table with the one measured, or write it."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    printed, _, after = rest.partition(END)
    if write:
        PAGE.write_text(before + BEGIN + measured + END + after)
    elif printed != measured:
        return [f"the table in {PAGE.relative_to(ROOT)} is not the one measured: make mutation ARGS=--write"]
    return []


if __name__ == "__main__":
    sys.exit(main())
