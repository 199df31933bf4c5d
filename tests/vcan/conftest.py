"""Which tests run where: `HOST_TESTS` on the host, all others of this folder where a vcan0 is promised.

``guest.py`` makes the promise by setting VCAN_JOB; a vcan0 that is missing there is a failure, never a skip.
Tests marked `boots_guest` start a guest each, which takes seconds: they run when ``-m`` names the marker.
"""

import os
from pathlib import Path

import pytest

HOST_TESTS = {"test_guest_runner.py"}
VCAN_TESTS = {path.name for path in Path(__file__).parent.glob("test_*.py")} - HOST_TESTS

collect_ignore = sorted(HOST_TESTS if "VCAN_JOB" in os.environ else VCAN_TESTS)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "boots_guest: boots a guest; run by `make test-vcan`")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "boots_guest" in config.getoption("markexpr"):
        return
    booting = [item for item in items if item.get_closest_marker("boots_guest")]
    config.hook.pytest_deselected(items=booting)
    items[:] = [item for item in items if item not in booting]
