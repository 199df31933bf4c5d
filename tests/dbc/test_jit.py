"""The compiled-code cache must never run machine code of a source that has changed."""

import os
import subprocess
import sys

OUTER = """
from dbc.jit import njit
from inner import step

@njit("int64(int64)", depends=("inner",))
def twice(x):
    return step(step(x))
"""

INNER = """
from dbc.jit import njit

@njit("int64(int64)")
def step(x):
    return x + {increment}
"""

REPORT = "import outer; print(outer.twice(0), sum(outer.twice.stats.cache_hits.values()))"


INTERPRETED = """
import numpy as np
from dbc.jit import entry_point, njit

@njit("uint64(int32[::1], uint64)")
def add(words, data):
    words[0] += 1
    return data + np.uint64(words[0])

words = np.array([41], np.int32)
total = entry_point(add)(words, np.uint64(2**63))
print(type(total) is int, total == 2**63 + 42, words[0], hasattr(add, "overloads"))
"""


def test_without_jit_the_same_function_runs_interpreted_on_plain_integers():
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", INTERPRETED]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["True", "True", "42", "False"]


def run(directory):
    """Import both modules in a fresh interpreter; return (twice(0), whether it came from the cache)."""
    command = [sys.executable, "-c", REPORT]
    result = subprocess.run(command, cwd=directory, capture_output=True, text=True, check=True)
    value, cache_hits = map(int, result.stdout.split())
    return value, cache_hits > 0


def test_a_change_in_an_imported_module_is_compiled_in(tmp_path):
    (tmp_path / "outer.py").write_text(OUTER)
    (tmp_path / "inner.py").write_text(INNER.format(increment=1))
    assert run(tmp_path) == (2, False)
    assert run(tmp_path) == (2, True)
    (tmp_path / "inner.py").write_text(INNER.format(increment=1000))
    assert run(tmp_path) == (2000, False)
