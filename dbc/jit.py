"""Numba compilation whose file cache sees changes in every source a function is built from.

With NUMBA_DISABLE_JIT=1 in the environment the same functions run interpreted: slow, for coverage, mutation
and debuggers.
"""

import functools
import hashlib
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

INTERPRETED = bool(getattr(numba.config, "DISABLE_JIT", False))
"""Whether the environment says NUMBA_DISABLE_JIT=1."""


def source_digest(*modules: str) -> str:
    """Return the SHA-256 of the sources of `modules` (a package counts with all its modules)."""
    digest = hashlib.sha256()
    for name in sorted(modules):
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(name)
        origin = Path(spec.origin)
        files = sorted(origin.parent.rglob("*.py")) if spec.submodule_search_locations else [origin]
        for file in files:
            digest.update(str(file.relative_to(origin.parent)).encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def njit(signature: str, *, depends: tuple[str, ...] = ()) -> Callable[[Callable[..., Any]], Any]:
    """Compile eagerly for one signature and cache on disk.

    Numba's own cache looks at the defining file only, so a change in an imported module would run stale
    machine code; here the cache entry carries a digest of the defining module and of `depends`.

    Parameters
    ----------
    signature : str
        Numba signature, e.g. ``"int64(uint64, int64)"``.
    depends : tuple of str
        Further modules or packages whose functions are compiled in.
    """

    def compile_function(function: Callable[..., Any]) -> Any:
        if INTERPRETED:
            return _interpreted(function)
        dispatcher: Any = numba.njit(error_model="numpy")(function)
        dispatcher.enable_caching()
        # private, but stable since numba 0.20; tests/dbc/test_jit.py fails if it stops working
        dispatcher._cache._cache_file._source_stamp = source_digest(function.__module__, *depends)
        dispatcher.compile(signature)
        dispatcher.disable_compile()
        return dispatcher

    return compile_function


def entry_point(function: Any) -> Callable[..., Any]:
    """Return what a function of `njit` compiled to, for calls from Python in a hot loop.

    It skips numba's choice among signatures, which costs as much again as the call; there is only one.
    """
    if INTERPRETED:
        interpreted: Callable[..., Any] = function
        return interpreted
    (compiled,) = function.overloads.values()
    call: Callable[..., Any] = compiled.entry_point
    return call


def _interpreted(function: Callable[..., Any]) -> Any:
    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return _plain(function(*map(_plain, arguments)))

    call.py_func = function  # type: ignore[attr-defined]
    return call


def _plain(argument: Any) -> Any:
    """Integers of any width as int, int32 arrays as what loads and stores int."""
    if isinstance(argument, np.integer):
        return int(argument)
    if isinstance(argument, np.ndarray) and argument.dtype == np.int32:
        return argument.data
    return argument
