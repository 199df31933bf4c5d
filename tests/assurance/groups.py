"""The modules that have to be right to the last branch, and the tests that say what is right."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ENVIRONMENT = {"NUMBA_DISABLE_JIT": "1", "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
"""What makes the tests run our sources interpreted, the same each time."""

PYTEST_OPTIONS = ("-q", "-pno:hil", "-pno:cacheprovider", "-Wignore")


@dataclass(frozen=True, slots=True)
class Group:
    """Modules, and the tests that have to notice what changes in them; relative to the repository.

    `tests` are files, `options` what pytest is told beside them.
    """

    targets: tuple[str, ...]
    tests: tuple[str, ...]
    options: tuple[str, ...]


def read_groups() -> list[Group]:
    """Return what assurance.toml says."""
    groups = []
    for group in tomllib.loads((HERE / "assurance.toml").read_text())["group"]:
        files = [file for pattern in group["targets"] for file in sorted(ROOT.glob(pattern))]
        targets = tuple(str(file.relative_to(ROOT)) for file in files if file.stat().st_size)
        left_out = tuple(f"--deselect={test}" for test in group.get("left_out", ()))
        groups.append(Group(targets, tuple(group["tests"]), (*PYTEST_OPTIONS, *left_out)))
    return groups
