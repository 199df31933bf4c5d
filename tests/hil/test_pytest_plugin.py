"""The bench in pytest, as its users run it: sessions of pytest in processes of their own."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from bench_runs import SAFETY_NET_S, forked

from hil.bench import Bench
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions
from hil.scenario import TimingLimits

ROOT = Path(__file__).parents[2]
DOCS = (ROOT / "docs/testing.md").read_text(encoding="utf-8")
FAULTS = (ROOT / "docs/faults.md").read_text(encoding="utf-8")

USER_TESTS = """
import pytest

def test_passes(bench):
    bench.run(0.05)
    assert bench.error_mm.max < 1.0

def test_fails(bench):
    bench.setpoint(0.01)
    bench.run(0.05)
    assert bench.error_mm.max < 0.0

@pytest.mark.bench(controller="pi", position_m=0.2, bit_rate=500_000)
def test_begins_as_marked(bench):
    bench.run(0.05)
    assert (bench.controller, bench.bit_rate) == ("pi", 500_000)
    assert bench.position_mm.last == pytest.approx(200.0, abs=1.0)

@pytest.mark.needs("wire_faults")
def test_spoils_the_wire(bench):
    bench.drop("PositionFeedback")
    bench.run(0.05)

def test_two_benches(bench_at):
    assert bench_at(position_m=0.1).position_mm is not bench_at(position_m=0.2)

def test_without_a_bench():
    pass
"""

ON_OTHER_MACHINES = """
import pytest

HEAVY = {"mass": 1.5, "delay_periods": 3, "position_lsb_um": 10}

@pytest.mark.bench(machine=HEAVY, tuning="pi_star")
def test_as_marked(bench):
    result = bench.result("")
    assert (result["controller"], result["tuning"]) == ("pi", "pi_star")
    assert result["machine"].items() >= HEAVY.items()

def test_nominal(bench):
    assert bench.result("")["machine"]["mass"] == 1.0

def test_one_after_another(bench_at):
    def rest_mm(machine):
        bench = bench_at(position_m=0.2, machine=machine)
        bench.run(0.05)
        return bench.position_mm.last

    assert rest_mm({}) == rest_mm({}) != rest_mm(HEAVY)

@pytest.mark.bench(machine={"mass": 99})
def test_too_heavy(bench):
    pass
"""

REFUSED = {  # by the bench, and what is said
    'bench.inject("nonsense")': "there is no fault 'nonsense': choose one of drop, ",
    'bench.inject("drop", mesage="DriveCommand")': "drop: there is no 'mesage', only at_s, message, count",
    'bench.inject("sensor_bias", bias_m=9)': "sensor_bias: bias_m is 9, must be a number from -1 to 1 m",
    'bench.power_off("gripper")': "power_off: node is 'gripper', must be one of controller, plant",
    'bench.silence("Gripper")': "there is no message 'Gripper': choose one of DriveCommand, ",
    "bench.run(-1)": "duration_s is -1, must be one period of 0.001 s or more",
    'bench_at(tuning="none")': "there is no tuning 'none': choose one of paper, ",
    "bench_at(positon_m=0.1)": "got an unexpected keyword argument 'positon_m'",
}

REFUSED_BEGINNINGS = {
    'law="pi"': "a bench takes no 'law': choose from controller, position_m, bit_rate, machine, tuning",
    '"pi"': "a bench takes no 'pi': say of what, e.g. controller='pi'",
    'controller="pid"': "there is no controller 'pid': choose one of p, pi, adrc, pi_ff, scheduled",
    "position_m=5": "position_m is 5, must be from 0 to 0.4 m",
    'position_m="top"': "position_m of a bench is 'top', must be a number",
    "bit_rate=0": "bit rate 0 is not from 10000 to 1000000 bit/s",
    "machine=3": "machine of a bench is 3, must be a table",
    'machine={"mass": 99}': "machine: mass is 99, must be a number from 0.1 to 10 times nominal",
    'tuning="none"': "there is no tuning 'none': choose one of paper, robust, pi_star, pi_ff, linear",
}

LOSES_ITS_FIRMWARE = """
import os, signal
from pathlib import Path

def firmware():
    for entry in Path("/proc").iterdir():
        try:
            parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
            name = (entry / "comm").read_text().strip()
        except OSError:
            continue
        if parent == str(os.getpid()) and name == "hil-controller":
            return int(entry.name)

def test_before(bench):
    bench.run(0.02)

def test_that_loses_it(bench):
    bench.run(0.02)
    os.kill(firmware(), signal.SIGKILL)
    bench.run(0.02)

def test_after_it(bench):
    bench.run(0.02)
    os.kill(firmware(), signal.SIGKILL)
    os.waitid(os.P_PID, firmware(), os.WEXITED | os.WNOWAIT)  # dead between two tests

def test_after(bench):
    bench.run(0.02)
    assert bench.controller_state == 2
"""


@dataclass(frozen=True)
class Session:
    """A session of pytest that is over."""

    folder: Path
    code: int
    said: str

    @property
    def lines(self) -> list[str]:
        return self.said.splitlines()

    def properties(self) -> dict[str, list[tuple[str, str]]]:
        """Return the properties of each test case in the JUnit file."""
        cases = ET.parse(self.folder / "junit.xml").iter("testcase")
        return {
            f"{case.get('classname')}.{case.get('name')}": [
                (p.get("name", ""), p.get("value", "")) for p in case.iter("property")
            ]
            for case in cases
        }


QUICK = ("-p", "no:cacheprovider", "-p", "no:hypothesispytest", "--color=no")


def run_pytest(folder: Path, *arguments: str, cwd: Path | None = None) -> Session:
    with TemporaryDirectory() as sockets:  # a short path: a socket's has at most 107 characters
        settings = {"XDG_RUNTIME_DIR": sockets, "PYTEST_ADDOPTS": "", "COLUMNS": "240"}
        done = forked(pytest.main, [*QUICK, *arguments], cwd or folder, **settings)
    return Session(folder, done.returncode, done.stdout)


def user_session(folder: Path, tests: str, *arguments: str) -> Session:
    (folder / "test_user.py").write_text(tests)
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\n")
    return run_pytest(folder, "--junitxml=junit.xml", *arguments)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return user_session(tmp_path_factory.mktemp("user"), USER_TESTS, "--hil-mode=inprocess")


def test_the_session_ends_as_its_tests_did(session):
    assert session.code == 1
    assert "1 failed, 5 passed" in session.said
    assert "hil: 5 scenarios on inprocess, 4 passed; 0 not applicable (none)" in session.lines


def test_a_failing_test_leaves_its_folder_and_says_where(session):
    folder = session.folder / "out/pytest/test_user.test_fails"
    assert {file.name for file in folder.iterdir()} == {
        "result.json",
        "trace.csv",
        "bus.log",
        "picture.png",
    }
    assert "results in out/pytest/test_user.test_fails" in session.lines
    assert [entry.name for entry in folder.parent.iterdir()] == ["test_user.test_fails"]


def test_the_replay_command_replays_the_run_to_the_last_bit(session, tmp_path):
    command = next(line for line in session.lines if line.startswith("replay: "))
    program, module, pytest_, *arguments = shlex.split(command.removeprefix("replay: "))
    assert (program, module, pytest_) == (sys.executable, "-m", "pytest")
    result = session.folder / "out/pytest/test_user.test_fails/result.json"
    again = subprocess.run(
        [program, module, pytest_, *arguments, f"--hil-out={tmp_path}"],
        cwd=session.folder,
        env=os.environ | {"PYTEST_ADDOPTS": ""},
        stdout=subprocess.DEVNULL,
        timeout=SAFETY_NET_S,
    )
    assert again.returncode == 1
    sha256 = json.loads(result.read_text())["bus_sha256"]
    assert json.loads((tmp_path / "test_user.test_fails/result.json").read_text())["bus_sha256"] == sha256


def test_the_replay_command_holds_where_pytest_was_started(session, tmp_path):
    again = run_pytest(
        session.folder,
        "--hil-mode=inprocess",
        f"--hil-out={tmp_path}",
        f"{session.folder.name}/test_user.py::test_fails",
        cwd=session.folder.parent,
    )
    test = f"{session.folder.name}/test_user.py::test_fails"
    assert f"replay: {sys.executable} -m pytest {test} --hil-mode=inprocess" in again.lines


def test_figures_go_into_the_junit_file(session):
    figures = dict(session.properties()["test_user.test_fails"])
    result = json.loads((session.folder / "out/pytest/test_user.test_fails/result.json").read_text())
    assert figures["bench"] == "inprocess"
    assert float(figures["rms_mm"]) == result["rms_mm"]
    assert float(figures["latency_us_p99"]) == result["timing"]["latency_us"]["p99"]
    assert figures["missed_periods"] == "0"
    assert figures["bus_sha256"] == result["bus_sha256"]
    assert session.properties()["test_user.test_without_a_bench"] == []


def test_what_the_interface_lacks_is_not_applicable_and_counted(tmp_path):
    collected = user_session(tmp_path, USER_TESTS, "--hil-mode=realtime", "--collect-only", "-q")
    assert "hil: 4 scenarios on hilbus, 0 passed; 1 not applicable (1 need wire_faults)" in collected.lines
    assert "test_spoils_the_wire" not in collected.said


def test_only_what_was_selected_is_counted(tmp_path):
    selected = user_session(tmp_path, USER_TESTS, "--hil-mode=realtime", "--collect-only", "-k", "passes")
    assert "hil: 1 scenario on hilbus, 0 passed; 0 not applicable (none)" in selected.lines


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--hil-interface=hilbus"], "--hil-interface needs --hil-mode realtime"),
        (["--rt-ratio=0.1"], "--rt-ratio needs --hil-mode realtime"),
        (["--hil-mode=realtime", "--rt-ratio=0"], "--rt-ratio: "),
        (["--hil-mode=realtime", "--rt-ratio=fast"], "--rt-ratio: "),
        (["--hil-firmware=cortex-m9"], "--hil-firmware: there is no firmware 'cortex-m9'"),
        (["--hil-mode=fast"], "argument --hil-mode: invalid choice: 'fast'"),
    ],
)
def test_a_wrong_option_is_refused_with_one_line(tmp_path, arguments, said):
    refused = user_session(tmp_path, USER_TESTS, *arguments)
    assert refused.code == 4
    assert len([line for line in refused.lines if said in line]) == 1
    assert "Traceback" not in refused.said


def test_a_need_that_nothing_has_is_refused(tmp_path):
    refused = user_session(tmp_path, USER_TESTS.replace("wire_faults", "wirefaults"), "--hil-mode=inprocess")
    assert refused.code == 4
    choose = "choose from machine, power, real_bus, tuning, virtual_time, wall_time, wire_faults"
    assert f"ERROR: test_user.py::test_spoils_the_wire: nothing has 'wirefaults': {choose}" in refused.lines


def test_what_the_bench_refuses_is_one_line_under_that_of_the_test(tmp_path):
    tests = [f"def test_{number}(bench, bench_at):\n    {call}\n" for number, call in enumerate(REFUSED)]
    session = user_session(tmp_path, "\n".join(tests), "--hil-mode=inprocess")
    assert f"{len(REFUSED)} failed" in session.said
    for call, said in REFUSED.items():
        told = session.lines.index(f">       {call}")
        following = [line for line in session.lines[told + 1 :] if line.startswith("E  ")]
        assert said in following[0]
    assert not re.search(r"hil/\S+\.py:\d", session.said), "a line of the bench's own files"


def test_what_a_bench_cannot_begin_with_is_one_line(tmp_path):
    tests = [
        f"@pytest.mark.bench({marker})\ndef test_{number}(bench):\n    pass\n"
        for number, marker in enumerate(REFUSED_BEGINNINGS)
    ]
    session = user_session(tmp_path, "import pytest\n\n" + "\n".join(tests), "--hil-mode=inprocess")
    assert f"{len(REFUSED_BEGINNINGS)} errors" in session.said
    titles = [n for n, line in enumerate(session.lines) if "ERROR at setup of test_" in line]
    assert [session.lines[n + 1] for n in titles] == list(REFUSED_BEGINNINGS.values())
    assert "def bench" not in session.said


def test_a_mistake_of_the_test_itself_keeps_its_traceback(tmp_path):
    tests = "def reach(table):\n    return table['no']\n\ndef test_own(bench):\n    reach({})\n"
    session = user_session(tmp_path, tests, "--hil-mode=inprocess")
    assert "    return table['no']" in session.said
    assert "test_user.py:2: KeyError" in session.said


@pytest.mark.parametrize("mode", ["inprocess", "lockstep"])
def test_a_test_chooses_machine_and_tuning(tmp_path, mode):
    session = user_session(tmp_path, ON_OTHER_MACHINES, f"--hil-mode={mode}")
    assert "3 passed, 1 error" in session.said
    assert "machine: mass is 99, must be a number from 0.1 to 10 times nominal" in session.said


def test_a_test_that_chooses_is_not_applicable_to_sides_that_others_start(tmp_path):
    other = ["--hil-mode=realtime", "--hil-interface=hilbus", "--hil-channel=none", "--collect-only"]
    collected = user_session(tmp_path, ON_OTHER_MACHINES, *other)
    assert "hil: 2 scenarios on hilbus, 0 passed; 2 not applicable (2 need machine)" in collected.lines


def test_a_lost_process_fails_its_test_only(tmp_path):
    session = user_session(tmp_path, LOSES_ITS_FIRMWARE)
    assert session.code == 1
    assert "1 failed, 3 passed" in session.said
    said = r"FAILED test_user\.py::test_that_loses_it - .*BenchError: the controller process ended .*"
    assert [line for line in session.lines if re.fullmatch(said, line)], session.said


# docs/testing.md, docs/faults.md


def code_blocks(language: str, page: str = DOCS) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


@pytest.mark.parametrize("page", [DOCS, FAULTS], ids=["testing.md", "faults.md"])
def test_the_example_in_the_documentation_passes(tmp_path, page):
    (example,) = code_blocks("python", page)
    session = user_session(tmp_path, example, "--hil-mode=inprocess")
    assert session.code == 0, session.said
    assert f"{example.count('def test_')} passed" in session.said


def test_the_violation_in_the_documentation_is_a_real_one():
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        bench = Bench(rig)
        bench.run(0.05)
        bench.delay("PositionFeedback", 0.0012)
        bench.run(0.05)
        with pytest.raises(AssertionError) as error:
            bench.check_timing(TimingLimits(feedback_age_us=450, latency_us=900))
    assert f"{error.value}\n" in code_blocks("text")


# the acceptance scenarios


@pytest.mark.long
def test_every_scenario_is_the_same_to_the_last_bit_in_both_virtual_modes(tmp_path):
    runs = []
    for mode in ("inprocess", "lockstep"):
        folder = tmp_path / mode
        folder.mkdir()
        out = [f"--hil-out={folder}", f"--junitxml={folder}/junit.xml"]
        session = run_pytest(folder, "tests/scenarios", f"--hil-mode={mode}", *out, cwd=ROOT)
        assert session.code == 0, session.said
        runs.append(
            {
                name: [value for key, value in properties if key == "bus_sha256"]
                for name, properties in session.properties().items()
            }
        )
    table = tomllib.loads((ROOT / "tests/scenarios/requirements.toml").read_text(encoding="utf-8"))
    assert sum(map(bool, runs[0].values())) == table["count"]["lockstep"]["run"]
    assert runs[0] == runs[1]
