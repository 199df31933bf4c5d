"""Closed-loop runs on many machines, in parallel, without the bus."""

import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np

from dbc.jit import source_digest
from firmware_py.calibration import Calibration
from hil.closed_loop import play_closed_loop
from hil.measure import METRICS
from hil.run.options import BenchError
from hil.scenario import Scenario, load_scenario
from plant_sim.machine import Machine

FIGURES = tuple(METRICS)
"""What is kept of each run; see `hil.closed_loop.ClosedLoopRun`."""

BOX_RUNS = ("sine", "sine_load", "lift_lower_load", "full_stroke")
"""Scenarios of the check of a box: a machine fails if its RMS is above `FAILED_RMS_MM` in any of them."""

FAILED_RMS_MM = 2.0

_RUNS_PER_TASK = 8
_PR_SET_PDEATHSIG = 1
_CLUSTER_TIMEOUT_S = 10


def failed(rms_mm: np.ndarray) -> np.ndarray:
    """Tell which RMS errors are failures: those above 2 mm, and what is not a number."""
    return ~(rms_mm <= FAILED_RMS_MM)


def box_rms_mm(
    calibration: Calibration,
    machines: Sequence[Machine],
    *,
    law: int | None = None,
    executor: Executor | None = None,
) -> np.ndarray:
    """Return the RMS errors of the box check.

    Parameters
    ----------
    calibration : Calibration
    machines : sequence of Machine
        Corners or samples of a `hil.study.box.Box`.
    law : int, optional
        Control law, instead of the calibration's default.
    executor : Executor, optional
        Where to run; by default on all cores of this machine. Whoever calls often keeps one of
        `all_cores` open.

    Returns
    -------
    rms_mm : ndarray, shape (machines, 4)
        A column for each of `BOX_RUNS`; see `failed`.
    """
    scenarios = [load_scenario(name) for name in BOX_RUNS]
    if executor is not None:
        return figures_of(calibration, scenarios, machines, executor, law=law)[..., 0]
    with all_cores() as cores:
        return figures_of(calibration, scenarios, machines, cores, law=law)[..., 0]


def figures_of(
    calibration: Calibration,
    scenarios: Sequence[Scenario],
    machines: Sequence[Machine],
    executor: Executor,
    *,
    law: int | None = None,
    progress: Callable[[int], None] = lambda machines_done: None,
) -> np.ndarray:
    """Play each scenario on each machine.

    Neither the number of workers nor the order in which they finish has a part in the result.

    Parameters
    ----------
    calibration : Calibration
    scenarios : sequence of Scenario
    machines : sequence of Machine
        Played on instead of the scenarios' own.
    executor : Executor
        From `all_cores`, or a cluster's.
    law : int, optional
        Control law, instead of the calibration's default.
    progress : callable
        Told how many machines are done; what it raises ends the runs.

    Returns
    -------
    figures : ndarray, shape (machines, scenarios, 3)
        The last axis is `FIGURES`.
    """
    size = max(1, _RUNS_PER_TASK // len(scenarios))
    tasks = [machines[begin : begin + size] for begin in range(0, len(machines), size)]
    rows: list[np.ndarray] = []
    for part in executor.map(partial(_figures, calibration, tuple(scenarios), law), tasks):
        rows.extend(part)
        progress(len(rows))
    return np.array(rows).reshape(len(machines), len(scenarios), len(FIGURES))


def _figures(
    calibration: Calibration, scenarios: Sequence[Scenario], law: int | None, machines: Sequence[Machine]
) -> np.ndarray:
    """Return the figures of one task, computed in this process."""
    figures = np.empty((len(machines), len(scenarios), len(FIGURES)))
    for row, machine in enumerate(machines):
        for column, scenario in enumerate(scenarios):
            run = play_closed_loop(scenario, calibration, law=law, machine=machine)
            figures[row, column] = [getattr(run, name) for name in FIGURES]
    return figures


@contextmanager
def all_cores(workers: int | None = None) -> Iterator[Executor]:
    """Fork worker processes, all compiled code in their memory, and end them with the context.

    Parameters
    ----------
    workers : int, optional
        How many; default: one for each core that this process may use.
    """
    executor = ProcessPoolExecutor(
        workers or _cores(),
        multiprocessing.get_context("fork"),
        initializer=_be_worker,
    )
    try:
        executor.submit(os.getpid).result()  # forks all of them, before the caller has threads
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """Use the workers of a Dask cluster, which need this version of the project installed.

    Parameters
    ----------
    address : str
        Of its scheduler, e.g. "tcp://127.0.0.1:8786".

    Raises
    ------
    BenchError
        If the package is missing, no scheduler answers there, it has no workers, or they have other sources.
    BrokenExecutor
        From the context, if workers are lost for good.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker
    except ImportError:
        raise BenchError("--cluster needs Dask: pip install '.[cluster]' in the project's folder") from None
    try:
        client = Client(address, timeout=_CLUSTER_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise BenchError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        _check_workers(client, address)
        executor = client.get_executor(pure=False)
        try:
            yield executor
        except (CancelledError, KilledWorker) as error:
            raise BrokenExecutor(f"the cluster lost the runs: {error}") from error
        finally:
            executor.shutdown(wait=False)


def _check_workers(client: Any, address: str) -> None:
    """Make sure that there are workers, and that they compute what this process would."""
    try:
        sources = client.run(_source)
    except Exception as error:  # whatever an import there raises
        raise BenchError(f"a worker of {address} cannot load ddh-hil ({error}): install it there") from error
    if not sources:
        raise BenchError(f"the Dask scheduler at {address} has no workers: start some with `dask worker`")
    if others := [worker for worker, source in sources.items() if source != _source()]:
        raise BenchError(f"worker {others[0]} has other sources of ddh-hil: install the same there")


def _source() -> str:
    return source_digest("dbc", "firmware_py", "plant_sim", "hil")


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1


def _be_worker() -> None:
    """Leave signals to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    with suppress(AttributeError, OSError):  # Linux; elsewhere a worker whose parent is killed stays
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
