"""The table of requirements and the scenarios are the same list, on every interface."""

from functools import cache

import pytest
from acceptance import FOLDER, TABLE

OPTIONS = {
    "inprocess": ["--hil-mode=inprocess"],
    "lockstep": ["--hil-mode=lockstep"],
    "hilbus": ["--hil-mode=realtime"],
    "socketcan": ["--hil-mode=realtime", "--hil-interface=socketcan"],
}
QUIETLY = ["--collect-only", "-q", "-c", "/dev/null", "-p", "no:cacheprovider", "-p", "no:faulthandler"]
TESTS = [row["test"] for row in TABLE["requirement"]]


class Collected:
    """What a session would run of this folder."""

    scenarios: frozenset[str] = frozenset()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.scenarios = frozenset(
            f"{item.path.name}::{item.name}"
            for item in session.items
            if item.path.parent == FOLDER and item.module.__name__ != __name__
        )


@cache
def scenarios_on(interface: str) -> frozenset[str]:
    """Collect this folder in a session of its own, so that nobody's -k or -x matters."""
    collected = Collected()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("PYTEST_ADDOPTS", raising=False)
        assert pytest.main([*QUIETLY, *OPTIONS[interface], str(FOLDER)], plugins=[collected]) == 0
    return collected.scenarios


def test_every_requirement_has_its_scenario_and_every_scenario_its_requirement():
    assert len(set(TESTS)) == len(TESTS)
    assert scenarios_on("inprocess") == set(TESTS)


def test_every_requirement_has_an_id_of_its_own_and_a_source():
    assert len({row["id"] for row in TABLE["requirement"]}) == len(TESTS)
    assert all(row["text"].endswith(".") and row["source"] for row in TABLE["requirement"])


@pytest.mark.parametrize("interface", OPTIONS)
def test_as_many_scenarios_run_as_the_table_says(interface):
    running = scenarios_on(interface)
    counted = {"run": len(running), "not_applicable": len(set(TESTS) - running)}
    assert counted == TABLE["count"][interface]
