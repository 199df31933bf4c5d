"""Fixtures of the acceptance scenarios, and the tie between a scenario and its requirement."""

from collections.abc import Callable, Generator

import pytest
from acceptance import CRUISE_BEGIN_S, CRUISE_FROM_M, FOLDER, TABLE, cruise

from hil.bench import Bench

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
    return (yield)


@pytest.fixture
def moving(bench_at: Callable[..., Bench]) -> Bench:
    """A bench in the midst of an even lift at 50 mm/s."""
    bench = bench_at(position_m=CRUISE_FROM_M)
    bench.setpoint(cruise)
    bench.run(CRUISE_BEGIN_S)
    return bench
