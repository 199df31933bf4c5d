"""Fixtures of the acceptance scenarios, and the tie between a scenario and its requirement."""

from collections.abc import Callable, Generator

import pytest
from acceptance import CRUISE_BEGIN_S, CRUISE_FROM_M, FOLDER, TABLE, InconclusiveError, cruise, stall

from hil.bench import Bench

RUNS_AGAIN = 3
"""How often a real-time scenario is run again whose run was inconclusive; a verdict is never run again."""

REQUIREMENT_OF = {row["test"]: row["id"] for row in TABLE["requirement"]}


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Generator[None, None, None]:
    """Note each scenario's requirement for JUnit XML; refuse a scenario that has none."""
    for item in items:
        if item.path.parent == FOLDER and "bench_at" in getattr(item, "fixturenames", ()):
            requirement = REQUIREMENT_OF.get(f"{item.path.name}::{item.name}")
            if requirement is None:
                raise pytest.UsageError(f"{item.nodeid} is not in requirements.toml: add its requirement")
            item.user_properties.append(("requirement", requirement))
            if item.config.getoption("hil_mode") == "realtime":
                item.add_marker(pytest.mark.flaky(reruns=RUNS_AGAIN, only_rerun="InconclusiveError"))
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Call a failure in real time inconclusive if the bus log shows the stall that explains it."""
    try:
        return (yield)
    except AssertionError as error:
        benches = getattr(item, "funcargs", {}).get("_benches", [])
        if benches and benches[-1].mode == "realtime" and (why := stall(benches[-1])):
            raise InconclusiveError(f"{why}: {error}") from error
        raise


@pytest.fixture
def bench_at(bench_at: Callable[..., Bench]) -> Callable[..., Bench]:
    """Return what makes a bench under the paper's ADRC, if nothing else is asked for.

    The default tuning has its gains, too, so that it can be chosen over the bus wherever the firmware runs.
    """
    return lambda **how: bench_at(**{"controller": "adrc", **how})


@pytest.fixture
def moving(bench_at: Callable[..., Bench]) -> Bench:
    """A bench in the midst of an even lift at 50 mm/s."""
    bench = bench_at(position_m=CRUISE_FROM_M)
    bench.setpoint(cruise)
    bench.run(CRUISE_BEGIN_S)
    return bench
