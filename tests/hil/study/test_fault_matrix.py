"""The whole fault matrix, played once: reactions, fault-tolerant time, effects, the page that shows it."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_py.chosen_tuning import chosen_tuning
from hil import cli
from hil.bench import Bench
from hil.faults.catalogue import KINDS
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions
from hil.study import stuck_sensor
from hil.study.fault_matrix import PHASES, Detector, Expectation, MatrixError, Reaction, load_matrix
from hil.study.fault_pages import markdown, page
from hil.study.fault_runs import Played, matrix_of, play_case, play_matrix
from hil.study.runs import all_cores

DOCS = Path(__file__).parents[3] / "docs" / "fault_matrix.md"
NO_MATRIX = Path(__file__).parents[3] / "README.md"
CASES = load_matrix()
NUMBER = re.compile(r"(?<![\w=.])\d+(?:\.\d+)?(?= of| ms| mm)")


@pytest.fixture(scope="module")
def played() -> list[Played]:
    with all_cores() as cores:
        return play_matrix(CASES, chosen_tuning(), cores)


def test_every_case_is_as_expected(played):
    assert len(played) == len(CASES)
    assert {f"{one.case.name} in {one.case.phase}": one.complaints for one in played if one.complaints} == {}


def test_every_kind_of_fault_is_played_in_every_phase():
    assert {(case.fault.kind, case.phase) for case in CASES} == {
        (kind, phase) for kind in KINDS for phase in PHASES
    }


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_fault_is_seen_to_do_something(played, kind):
    """A published fault that changes neither the bus nor the rod's way in any phase is none."""
    outcomes = [one.outcome for one in played if one.case.fault.kind == kind]
    assert any(outcome.bus_differs or outcome.effect_mm > 0.001 for outcome in outcomes)


def test_what_stops_does_so_within_the_fault_tolerant_time(played):
    """Three cycles of the message, one frame, ω / a at 4000 rad/s², the motor's lag of 5 ms down to 1 rpm.

    A stuck position takes 50 ms at 1500 rpm, and before that what leads to 1500 rpm.
    """
    stops = [one for one in played if one.case.expected.reaction.stops and one.case.phase != "standby"]
    assert len(stops) > 60
    for one in stops:
        expected, speed_rpm = one.case.expected, one.outcome.speed_rpm
        trips_ms = (53, 100, 600) if "PositionStuck" in expected.signals else (3, 30, 300)
        assert (expected.trip_ms or expected.within_ms) in trips_ms
        ramp_ms = speed_rpm * math.pi / 30 / 4000 * 1e3
        lag_ms = 5.0 * math.log(max(min(speed_rpm, 4000 * 0.005 * 30 / math.pi), 1.0))
        allowed_ms = (expected.trip_ms or expected.within_ms) + 1.0 + ramp_ms + lag_ms
        assert one.outcome.at_rest_ms <= allowed_ms
        assert one.outcome.drive in ("fault", "switch_on_disabled", "ready_to_switch_on")


def test_stops_are_from_a_fast_motor(played):
    assert max(one.outcome.speed_rpm for one in played if one.case.expected.reaction is Reaction.SAFE) > 1400


def test_in_standby_no_fault_turns_the_motor(played):
    standby = [one.outcome for one in played if one.case.phase == "standby"]
    assert all(outcome.at_rest_ms == 0.0 and outcome.drive != "operation_enabled" for outcome in standby)


def test_a_sensor_that_lies_in_valid_frames_is_undetected_and_costs_what_it_lies():
    expected = {(case.name, case.phase): case.expected for case in CASES}
    for name, off_mm in (("sensor_bias,bias_m=0.002", 2.0), ("sensor_drift,drift_m_s=0.01", 8.0)):
        for phase in ("tracking", "holding"):
            assert expected[name, phase].reaction is Reaction.UNDETECTED
            assert expected[name, phase].by is Detector.NOBODY
            assert expected[name, phase].error_mm == off_mm


def test_the_page_shows_what_was_played(played):
    """Word for word; figures to what another processor's rounding may change."""
    shown = DOCS.read_text(encoding="utf-8").split("<!-- matrix: begin -->\n")[1]
    shown = shown.split("<!-- matrix: end -->")[0]
    ours = markdown(matrix_of(played, chosen_tuning()))
    assert NUMBER.sub("#", ours) == NUMBER.sub("#", shown), "run `make faults`"
    theirs = [float(number) for number in NUMBER.findall(shown)]
    assert [float(number) for number in NUMBER.findall(ours)] == pytest.approx(theirs, rel=0.02, abs=0.11)


def test_the_page_shows_how_late_a_stuck_sensor_is_found():
    shown = DOCS.read_text(encoding="utf-8").split("<!-- stuck: begin -->\n")[1]
    assert shown.split("<!-- stuck: end -->")[0] == stuck_sensor.markdown(), "run `make faults`"


def test_the_report_holds_every_case_and_needs_nothing_else(played):
    text = page(matrix_of(played, chosen_tuning()), {})
    assert all(f"<code>{case.name.replace(',', ', ')}</code>" in text for case in CASES)
    assert not re.search(r"""(src|href)=["']?http""", text)


def test_only_so_many_workers_have_no_part_in_the_result():
    some = [case for case in CASES if case.fault.kind in ("bit_errors", "sensor_noise")]
    tables = []
    for jobs in (1, 2):
        with all_cores(jobs) as cores:
            tables.append([one.table() for one in play_matrix(some, chosen_tuning(), cores)])
    assert tables[0] == tables[1]


# the judge


@pytest.fixture(scope="module")
def judge():
    """Return what judges a case, played for real, under another expectation."""
    with InprocessRig(RigOptions(record_directory=Path())) as rig:

        def complaints(name: str, phase: str, **expected) -> tuple[str, ...]:
            case = next(case for case in CASES if (case.name, case.phase) == (name, phase))
            baseline = Bench(rig, position_m=float(PHASES[phase].reference_m(PHASE_BEGIN)[0]))
            baseline.setpoint(PHASES[phase].reference_m)
            baseline.run(1.3)
            return play_case(
                rig, replace(case, expected=replace(case.expected, **expected)), baseline
            ).complaints

        yield complaints


PHASE_BEGIN = np.zeros(1)
LOST, BIAS, LEAK = "drop,message=PositionFeedback,count=1000", "sensor_bias,bias_m=0.002", "leak,factor=10"
SILENT_DRIVE = "drop,message=DriveCommand,count=1000"


@pytest.mark.parametrize(
    ("name", "expected", "complaint"),
    [
        (LOST, {"by": Detector.DRIVE}, "noticed by controller, not drive"),
        (LOST, {"by": Detector.NOBODY}, "noticed by controller, not nobody"),
        (LOST, {"within_ms": 2.0, "trip_ms": 3.0}, "noticed after 2.5 ms, not 2"),
        (LOST, {"trip_ms": 1.0}, "ms, not"),
        (LOST, {"signals": ()}, "signals FeedbackLost, not none"),
        (LOST, {"reaction": Reaction.DRIVE_STOP}, "the drive ended in switch_on_disabled"),
        (LOST, {"reaction": Reaction.STANDBY}, "the controller ended in safe, not standby"),
        (LOST, {"reaction": Reaction.TOLERATED, "error_mm": 1e3}, "did not stay in run but ended in safe"),
        (SILENT_DRIVE, {"reaction": Reaction.SAFE}, "the drive ended in fault"),
        (BIAS, {"reaction": Reaction.SAFE}, "the controller ended in run, not safe"),
        (BIAS, {"reaction": Reaction.SAFE}, "the motor turned to the end"),
        (BIAS, {"error_mm": 1.0}, "mm off in the end, not about 1 mm"),
        (BIAS, {"error_mm": 4.0}, "mm off in the end, not about 4 mm"),
        (LEAK, {"error_mm": 1.0}, "not below 1 mm"),
    ],
)
def test_whatever_is_not_as_expected_is_said(judge, name, expected, complaint):
    assert judge(name, "tracking") == ()
    assert any(complaint in said for said in judge(name, "tracking", **expected))


def test_a_slower_motor_is_allowed_less():
    expected = Expectation(reaction=Reaction.SAFE, source="", within_ms=3.0)
    assert expected.allowed_stop_ms(0.0) == 4.0
    assert expected.allowed_stop_ms(3000.0) == pytest.approx(4.0 + 78.5 + 26.3, abs=0.1)
    assert expected.allowed_stop_ms(-1500.0) == expected.allowed_stop_ms(1500.0) < 70.0


# the file and the command line


def entry(text: str) -> str:
    return f'[[fault]]\nfault = "sensor_stuck"\nreaction = "tolerated"\nsource = "x"\nerror_mm = 1\n{text}\n'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[[fault]", "fault matrix: "),
        ('[[fault]]\nreaction = "safe"', "there is no fault ''"),
        ("fault = 3", "faults are tables [[fault]]"),
        ("error_mm = 3", "error_mm is a table with some of standby, tracking"),
        ('[[fault]]\nfault = "sensor_glued"', "there is no fault 'sensor_glued'"),
        ('[[fault]]\nfault = "sensor_bias"', "bias_m is missing"),
        (entry("errors = 3"), "sensor_stuck in standby: no key 'errors', only by, reaction"),
        (entry('by = "dog"'), "by is 'dog', must be one of controller, drive, CAN, nobody"),
        (entry("").replace("tolerated", "ignored"), "reaction is 'ignored', must be one of safe, drive_stop"),
        (entry("").replace("reaction", "#"), "reaction is None, must be one of safe, drive_stop"),
        (entry('signals = ["Lost"]'), "signals is ['Lost'], must be a list of some of CalibrationInvalid"),
        (entry("within_ms = -1"), "within_ms is -1, must be a number from 0 on"),
        (entry("holding.error_mm = nan"), "sensor_stuck in holding: error_mm is nan, must be a number"),
        (entry('holding = "safe"'), "sensor_stuck: holding must be a table"),
        (entry('drawn = ["lunch"]'), "sensor_stuck: drawn must be a list of some of standby"),
        (entry("").replace("stuck", "stuck,at_s=1"), "the phase says when, without at_s"),
        (entry("holding.limit = 3"), "sensor_stuck in holding: no key 'limit'"),
    ],
)
def test_a_matrix_that_makes_no_sense_is_refused_in_one_line(text, complaint):
    with pytest.raises(MatrixError) as refused:
        load_matrix(text)
    assert complaint in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_phase_changes_the_keys_that_it_names():
    cases = load_matrix("[error_mm]\nholding = 9\n" + entry('tracking = { error_mm = 2, by = "CAN" }'))
    by_phase = {case.phase: case.expected for case in cases}
    assert (by_phase["tracking"].error_mm, by_phase["tracking"].by) == (2, Detector.CAN)
    assert (by_phase["holding"].error_mm, by_phase["holding"].by) == (1, Detector.NOBODY)


def test_the_command_line_plays_what_is_asked_for(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["faults", "--fault", "sensor_dropout", "--fault", "sensor_bias", "--phase", "tracking"]
    assert cli.main([*arguments, "--jobs", "1", "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "matrix.json").read_text())
    assert [case["kind"] for case in printed["cases"]] == ["sensor_bias", "sensor_dropout"]
    assert {file.name for file in out.iterdir()} == {"matrix.json", "report.html", "courses.svg"}


def test_the_command_line_says_what_is_not_as_expected(tmp_path, capsys):
    own = tmp_path / "own.toml"
    own.write_text(entry("").replace("tolerated", "safe"))
    arguments = ["faults", "--matrix", str(own), "--phase", "holding", "--jobs", "1"]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 1
    assert "sensor_stuck in holding: the controller ended in run, not safe" in capsys.readouterr().out
    assert "NOT AS EXPECTED" in (tmp_path / "out" / "report.html").read_text()


def test_the_picture_has_no_empty_axes(tmp_path):
    kinds = ["--fault", "drop", "--fault", "sensor_bias", "--fault", "reset"]
    assert cli.main(["faults", *kinds, "--phase", "tracking", "--jobs", "1", "--out", str(tmp_path)]) == 0
    drawn = [
        case for case in CASES if case.fault.kind in kinds and case.phase == "tracking" and case.is_drawn
    ]
    assert len(drawn) == 4  # one in the second row of three
    assert len(re.findall(r'id="axes_\d+"', (tmp_path / "courses.svg").read_text())) == 2 * len(drawn)


@pytest.mark.parametrize(("load_n", "sinks_mm_s"), [(0, 3.4), (2000, 8.4)])
def test_the_safe_state_does_not_hold_a_load(load_n, sinks_mm_s):
    page = (Path(__file__).parents[3] / "docs/fault_matrix.md").read_text(encoding="utf-8")
    assert f"{sinks_mm_s} mm/s" in page
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        bench = Bench(rig, position_m=0.2)
        bench.load_force(load_n)
        bench.run(1.0)
        bench.inject("sensor_status", status=2)
        bench.run(0.75)
        sunk_mm = np.ptp(bench.position_mm.between(1.25, 1.75).values)
    assert bench.motor_speed_rpm.last == pytest.approx(0, abs=0.1)
    assert sunk_mm / 0.5 == pytest.approx(sinks_mm_s, abs=0.1)


def test_the_table_fits_a_narrow_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    arguments = ["faults", "--fault", "drop", "--phase", "standby", "--jobs", "1", "--out", str(tmp_path)]
    assert cli.main(arguments) == 0
    said = capsys.readouterr().out
    assert "as expected" in said
    assert "message=ControllerCommand," in said
    assert max(map(len, said.splitlines()[:-1])) <= 80


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--jobs", "0"], "--jobs is 0, must be 1 or more"),
        (["--matrix", "nowhere.toml"], "cannot read the matrix nowhere.toml"),
        (["--matrix", str(NO_MATRIX)], f"{NO_MATRIX}: fault matrix: Expected '='"),
        (["--tuning", "sporty"], "there is no tuning 'sporty'"),
        (["--fault", "gremlin"], "gremlin"),
        (["--phase", "lunch"], "lunch"),
    ],
)
def test_wrong_input_is_refused_at_the_door(arguments, complaint, tmp_path, capsys):
    try:
        code = cli.main(["faults", *arguments, "--out", str(tmp_path / "out")])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
