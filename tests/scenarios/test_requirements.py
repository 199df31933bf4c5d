"""The table of requirements and the scenarios are the same list, on every interface."""

import os
import subprocess
import sys
from functools import cache

import pytest
from acceptance import FOLDER, TABLE

OPTIONS = {
    "inprocess": ["--hil-mode=inprocess"],
    "lockstep": ["--hil-mode=lockstep"],
    "hilbus": ["--hil-mode=realtime"],
    "socketcan": ["--hil-mode=realtime", "--hil-interface=socketcan"],
}
TESTS = [row["test"] for row in TABLE["requirement"]]


@cache
def scenarios_on(interface: str) -> frozenset[str]:
    """Collect this folder in a session of its own, so that nobody's -k or -x matters."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "--color=no", "-o", "addopts="]
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", "--ignore", __file__, *OPTIONS[interface], str(FOLDER)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTEST_ADDOPTS": ""},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if "::" in line]
    return frozenset(line.rpartition("/")[2] for line in lines)


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
