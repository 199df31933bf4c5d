"""Replay: the firmware computes again what it sent, from a log in any format; every departure is found."""

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bench_runs import hil
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.contract import Contract
from dbc.frame import ERR_FLAG, Frame
from dbc.node import PERIOD_NS
from firmware_py.chosen_firmware import firmware_of_text
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.node import PHASE_NS
from hil import cli
from hil.bus.wire import FrameFault, Wire
from hil.bus_log import read_bus_log, write_bus_log
from hil.run.inprocess import InprocessRig, run_inprocess
from hil.run.options import BenchError, RigOptions, RunOptions
from hil.scenario import CONTROLLERS, Scenario, law_of, load_scenario
from hil.study.replay import Replay, replay
from hil.supervisor import BRING_UP_PERIODS

CONTRACT = Contract.load()
FORMATS = (".log", ".asc", ".blf", ".mf4")
OURS = ("DriveCommand", "ControllerStatus", "ObserverState")
COMMAND = CONTRACT.drive_command.can_id
SHORT = Scenario("short", "a load step on a moving rod", "sine", 0.6, ((0.3, 3000.0),), {}, {})


@cache
def recorded(
    scenario: str = "", controller: str = "", tuning: str = "robust", bit_rate: int = 1_000_000
) -> np.ndarray:
    """Return the traffic of a built-in scenario, or of the short one."""
    options = RunOptions(
        scenario=load_scenario(scenario) if scenario else SHORT,
        controller=controller,
        tuning=chosen_tuning(tuning),
        record_directory=Path(),
        bit_rate=bit_rate,
    )
    return run_inprocess(options).traffic


def spoiled(spoil: Callable[[Wire], None], periods: int = 400, controller: str = "scheduled") -> np.ndarray:
    """Return the traffic of a run in which something happens to the wire 100 periods after the bring-up."""
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        session = rig.begin(controller, 0.1)
        session.run_to(BRING_UP_PERIODS + 100)
        assert session.wire is not None
        spoil(session.wire)
        session.run_to(BRING_UP_PERIODS + 250)
        for fault_reset, enable, period in ((0, 0, 260), (1, 0, 270), (0, 0, 280), (0, 1, 290)):
            session.supervisor.plan(BRING_UP_PERIODS + period, enable=enable, fault_reset=fault_reset)
        session.run_to(BRING_UP_PERIODS + periods)
        return session.recording().traffic


def replayed(traffic: np.ndarray, tuning: str = "robust", bit_rate: int = 1_000_000, **options) -> Replay:
    return replay(traffic, CONTRACT, chosen_tuning(tuning).calibration, bit_rate, **options)


def assert_computed_again(found: Replay, traffic: np.ndarray) -> None:
    """Every frame the controller sent is in the comparison, and is the same."""
    assert found.differences == []
    assert found.equal_periods == found.compared_periods > 0
    compared = {message.name: int(message.is_equal.sum()) for message in found.messages}
    sent = {name: int((traffic[:, 1] == CONTRACT.message(name).can_id).sum()) for name in OURS}
    assert compared == sent


# computed again


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_run_is_computed_again_from_a_log_in_any_format(tmp_path, suffix):
    traffic = recorded()
    write_bus_log(tmp_path / f"bus{suffix}", traffic)
    found = replayed(read_bus_log(tmp_path / f"bus{suffix}").traffic)
    assert_computed_again(found, traffic)
    assert found.phase.exact
    assert (found.unsure_ns.size, found.error_frames) == (0, 0)


@pytest.mark.parametrize("bit_rate", [500_000, 1_000_000])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_every_law_is_computed_again(controller, bit_rate):
    traffic = recorded(controller=controller, bit_rate=bit_rate)
    assert_computed_again(replayed(traffic), traffic)


def test_on_an_overloaded_bus_what_was_sent_is_computed_again_and_the_rest_is_named():
    found = replayed(recorded(bit_rate=250_000))
    assert all(message.is_equal.all() for message in found.messages)
    assert len(found.messages[0].recorded) > 300
    assert {d.message for d in found.differences} == {"ControllerStatus", "ObserverState"}
    assert all(d.recorded is None for d in found.differences)


@pytest.mark.long
@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    ("scenario", "controller", "tuning", "bit_rate"),
    [
        ("sine_load", "scheduled", "robust", 1_000_000),
        ("sine_load", "scheduled", "robust", 500_000),
        *(("lift_lower_load", law, "paper", 1_000_000) for law in ("p", "pi", "adrc")),
        ("lift_lower_load", "pi_ff", "pi_ff", 1_000_000),
        ("lift_lower_load", "scheduled", "robust", 500_000),
    ],
)
def test_whole_scenarios_are_computed_again(tmp_path, suffix, scenario, controller, tuning, bit_rate):
    traffic = recorded(scenario, controller, tuning, bit_rate)
    write_bus_log(tmp_path / f"bus{suffix}", traffic)
    found = replayed(read_bus_log(tmp_path / f"bus{suffix}").traffic, tuning)
    assert_computed_again(found, traffic)


def faulty(message: str, fault: FrameFault, argument: int, count: int) -> Callable[[Wire], None]:
    return lambda wire: wire.spoil(CONTRACT.message(message).can_id, fault, argument, count)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(faulty("PositionFeedback", FrameFault.DROP, 0, 2), id="two lost"),
        pytest.param(faulty("PositionFeedback", FrameFault.DROP, 0, 10), id="lost until the safe state"),
        pytest.param(faulty("PositionSetpoint", FrameFault.CORRUPT, 1 << 30, 5), id="corrupt"),
        pytest.param(faulty("PositionFeedback", FrameFault.DELAY, 1_200_000, 1), id="late, then two at once"),
        pytest.param(faulty("DriveStatus", FrameFault.REPEAT, 0, 3), id="repeated"),
        pytest.param(faulty("PositionFeedback", FrameFault.DESTROY, 40, 3), id="destroyed and sent again"),
        pytest.param(lambda wire: wire.disturb(1e-3, 50_000_000, seed=1), id="bit errors"),
        pytest.param(lambda wire: wire.babble(Frame(0, 8, 0), 0, 60_000_000), id="held up for 60 ms"),
    ],
)
def test_a_run_with_faults_is_computed_again(tmp_path, spoil, suffix):
    traffic = spoiled(spoil)
    write_bus_log(tmp_path / f"bus{suffix}", traffic)
    assert_computed_again(replayed(read_bus_log(tmp_path / f"bus{suffix}").traffic), traffic)


def test_error_frames_are_passed_over_and_counted():
    traffic = spoiled(faulty("PositionFeedback", FrameFault.DESTROY, 40, 3))
    assert int((traffic[:, 1] & ERR_FLAG != 0).sum()) == 3
    assert replayed(traffic).error_frames == 3


def test_commands_lost_on_the_bus_are_told_by_the_counter_and_are_no_difference():
    traffic = spoiled(faulty("DriveCommand", FrameFault.DROP, 0, 2))
    found = replayed(traffic)
    assert_computed_again(found, traffic)
    assert [len(message.lost) for message in found.messages] == [2, 0, 0]


def test_a_command_held_up_beyond_the_next_one_is_found():
    traffic = spoiled(faulty("DriveCommand", FrameFault.DELAY, 1_500_000, 1))
    assert_computed_again(replayed(traffic), traffic)


def test_another_reset_in_the_log_begins_the_firmware_anew():
    both = np.concatenate([recorded(), shifted(recorded(controller="pi"))])
    assert_computed_again(replayed(both), both)


def shifted(traffic: np.ndarray) -> np.ndarray:
    """Return a log that begins with the first whole period after its own end."""
    later = traffic.copy()
    later[:, 0] += np.uint64((int(traffic[-1, 0]) // PERIOD_NS + 1) * PERIOD_NS)
    return later


# departures


@pytest.mark.parametrize("message", OURS)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_one_flipped_bit_is_found_at_its_frame(message, data):
    traffic = recorded().copy()
    codec = CONTRACT.message(message)
    rows = np.flatnonzero(traffic[:, 1] == codec.can_id)
    row = rows[data.draw(st.integers(0, len(rows) - 1))]
    bit = data.draw(st.integers(0, 8 * codec.dlc - 1))
    intact = int(traffic[row, 3])
    traffic[row, 3] = intact ^ 1 << bit
    (difference,) = replayed(traffic).differences
    assert difference.time_ns == traffic[row, 0]
    assert difference.message == message
    assert difference.recorded.data == intact ^ 1 << bit
    assert difference.computed.data == intact


def test_a_command_spoiled_on_the_bus_is_found_at_its_frame():
    traffic = spoiled(faulty("DriveCommand", FrameFault.CORRUPT, 1 << 33, 2))
    differences = replayed(traffic).differences
    commands = traffic[traffic[:, 1] == COMMAND]
    assert [difference.time_ns for difference in differences] == commands[200:202, 0].tolist()
    assert all(d.recorded.data ^ d.computed.data == 1 << 33 for d in differences)


@pytest.mark.parametrize("tuning", ["linear", "paper"])
def test_another_tuning_departs_where_a_run_under_it_does(tuning):
    """Up to there both runs have the same traffic, and so the second one is the oracle."""
    traffic = recorded(controller="adrc", tuning="robust" if tuning == "linear" else "linear")
    other = recorded(controller="adrc", tuning=tuning)
    ours, theirs = (t[t[:, 1] == COMMAND] for t in (traffic, other))
    first = np.flatnonzero(ours[:, 3] != theirs[:, 3])[0]
    departed = next(d for d in replayed(traffic, tuning).differences if d.message == "DriveCommand")
    assert departed.time_ns == ours[first, 0]
    assert (departed.recorded.data, departed.computed.data) == (ours[first, 3], theirs[first, 3])


def test_another_law_takes_the_place_of_the_recorded_one():
    """Under the law of the other run the same commands come, as far as the inputs are the same."""
    traffic = recorded(controller="pi")
    other = recorded(controller="scheduled")
    ours, theirs = (t[t[:, 1] == COMMAND] for t in (traffic, other))
    first = np.flatnonzero(ours[:, 3] != theirs[:, 3])[0]
    departed = next(
        d for d in replayed(traffic, law=law_of("scheduled")).differences if d.message == "DriveCommand"
    )
    assert (departed.time_ns, departed.computed.data) == (ours[first, 0], theirs[first, 3])


def test_a_frame_that_the_firmware_did_not_send_is_a_difference():
    traffic = recorded()
    babble = traffic[np.flatnonzero(traffic[:, 1] == COMMAND)[300]].copy()
    babble[0] += 150_000
    with_babble = np.insert(traffic, np.searchsorted(traffic[:, 0], babble[0]), babble, axis=0)
    (difference,) = replayed(with_babble).differences
    assert (difference.time_ns, difference.computed) == (babble[0], None)


def test_a_status_that_is_not_in_the_log_is_a_difference():
    traffic = recorded()
    status = np.flatnonzero(traffic[:, 1] == CONTRACT.controller_status.can_id)[3]
    (difference,) = replayed(np.delete(traffic, status, axis=0)).differences
    assert (difference.message, difference.recorded) == ("ControllerStatus", None)
    assert difference.computed.data == traffic[status, 3]


def test_a_firmware_that_fell_silent_is_a_difference():
    traffic = recorded()
    silent = (traffic[:, 1] == COMMAND) & (traffic[:, 0] > 500_000_000)
    differences = replayed(traffic[~silent]).differences
    assert {difference.message for difference in differences} == {"DriveCommand"}
    assert all(difference.recorded is None for difference in differences)


# what the log does not tell


@pytest.mark.parametrize("bit_rate", [500_000, 1_000_000])
@pytest.mark.parametrize("offset_ns", [37_000, 500_000, 1_795_000_000_123_456_000])
def test_the_timers_phase_is_inferred_where_the_logs_time_is_another(offset_ns, bit_rate):
    traffic = recorded(bit_rate=bit_rate).copy()
    traffic[:, 0] += np.uint64(offset_ns)
    found = replayed(traffic, bit_rate=bit_rate)
    assert not found.phase.exact
    assert found.phase.phase_ns == (PHASE_NS + offset_ns) % PERIOD_NS
    assert_computed_again(found, traffic)


def test_where_a_log_cannot_tell_whether_frame_or_timer_was_first_is_said():
    """At 800 kbit/s a bit takes 1.25 µs, and a log has whole µs."""
    traffic = recorded(bit_rate=800_000).copy()
    row = np.flatnonzero(traffic[:, 1] == CONTRACT.position_setpoint.can_id)[200]
    timer_ns = int(traffic[row, 0]) // PERIOD_NS * PERIOD_NS + PHASE_NS
    traffic[row, 0] = timer_ns
    traffic = traffic[np.argsort(traffic[:, 0], kind="stable")]
    assert timer_ns in replayed(traffic, bit_rate=800_000).unsure_ns
    assert replayed(traffic, bit_rate=1_000_000).unsure_ns.size == 0


def test_commands_without_a_phase_are_refused():
    traffic = recorded().copy()
    traffic[:, 0] += 37_000
    traffic[:, 0] += traffic[:, 0] // np.uint64(500)  # a clock that is 0.2 % fast
    with pytest.raises(BenchError, match="keep no phase"):
        replayed(traffic)


def test_what_came_before_the_reset_is_not_compared():
    traffic = recorded()
    before = traffic[traffic[:, 0] > 300_000_000]
    with pytest.raises(BenchError, match="no BenchControl reset in the log"):
        replayed(before)
    found = replayed(np.concatenate([before, shifted(traffic)]))
    assert found.begin_ns == shifted(traffic)[0, 0]
    assert_computed_again(found, traffic)


def test_a_log_without_commands_is_refused():
    traffic = recorded()
    with pytest.raises(BenchError, match="no DriveCommand after the reset"):
        replayed(traffic[traffic[:, 1] != COMMAND])


# the command line


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "bus.log"
    write_bus_log(path, recorded())
    return path


def test_exit_code_0_says_that_all_is_computed_again(log, tmp_path, capsys):
    assert cli.main(["replay", str(log), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "700 of 700 control periods equal" in said.out
    assert said.err == ""
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"replay.json", "replay.png"}
    assert (tmp_path / "out" / "replay.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_exit_code_1_comes_with_the_first_difference_in_signals(log, tmp_path, capsys):
    lines = log.read_text().splitlines(keepends=True)
    row = [number for number, line in enumerate(lines) if " 100#" in line][250]
    time, channel, frame, direction = lines[row].split()
    velocity = int.from_bytes(bytes.fromhex(frame[12:16]), "little", signed=True)
    changed = (velocity + 4).to_bytes(2, "little", signed=True).hex().upper()
    lines[row] = f"{time} {channel} {frame[:12]}{changed} {direction}\n"
    path = tmp_path / "changed.log"
    path.write_text("".join(lines))
    assert cli.main(["replay", str(path), "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert (result["differences"], result["periods"]["equal"]) == (1, 699)
    first = result["first_difference"]
    assert (first["message"], f"({first['time_s']:f})") == ("DriveCommand", time)
    signals = [first[side]["signals"]["TargetVelocity"] for side in ("recorded", "computed")]
    assert signals == [f"{(velocity + 4) / 4:g} rpm", f"{velocity / 4:g} rpm"]
    assert cli.main(["replay", str(path)]) == 1
    said = capsys.readouterr().out
    assert f"first difference of DriveCommand: {time[1:-1]} s" in said
    assert f"TargetVelocity    {(velocity + 4) / 4:g} rpm" in said


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_log_that_was_cut_off_is_compared_so_far_and_is_not_equal(tmp_path, capsys, suffix):
    path = tmp_path / f"bus{suffix}"
    write_bus_log(path, recorded())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert cli.main(["replay", str(path), "--json"]) == 1
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["differences"] == 0
    assert result["log_damage"]
    assert 0.2 < result["log_end_s"] < 0.5
    assert said.err == (
        f"hil: {path} ends early or is damaged ({result['log_damage']}): "
        f"compared up to {result['log_end_s']:.6f} s\n"
    )


def test_an_mf4_that_was_cut_off_is_refused_in_one_line(tmp_path):
    path = tmp_path / "bus.mf4"
    write_bus_log(path, recorded())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused = hil("replay", str(path))
    (line,) = refused.stderr.splitlines()
    assert refused.returncode == 2
    assert line.startswith(f"hil: {path}: not a .mf4 bus log, or a damaged one")


def test_a_log_cut_at_a_line_end_is_told_by_the_run_beside_it(tmp_path, capsys):
    played = ("run", "sine", "--mode", "inprocess", "--duration", "0.1", "--out", str(tmp_path))
    assert cli.main([*played]) == 0
    path = tmp_path / "bus.log"
    lines = path.read_text().splitlines(keepends=True)
    assert cli.main(["replay", str(path)]) == 0
    path.write_text("".join(lines[:400]))
    capsys.readouterr()
    assert cli.main(["replay", str(path)]) == 1
    said = capsys.readouterr()
    assert f"(400 frames, {len(lines)} in result.json)" in said.err
    last_s = lines[399].split()[0].strip("()")
    assert f"control periods equal, from 0.000000 s to {last_s} s" in said.out
    other = path.rename(tmp_path / "another.log")
    assert cli.main(["replay", str(other)]) == 0, "no log of that run"


def test_another_firmware_is_compared_with_its_execution_time(tmp_path):
    firmware, path = "cortex-m4,execution_us=32.0", tmp_path / "bus.log"
    options = RunOptions(SHORT, "scheduled", record_directory=tmp_path, firmware=firmware_of_text(firmware))
    write_bus_log(path, run_inprocess(options).traffic)
    assert cli.main(["replay", str(path), "--firmware", firmware]) == 0
    assert cli.main(["replay", str(path), "--firmware", "python,execution_us=32"]) == 0
    assert cli.main(["replay", str(path)]) == 1, "the execution time in ControllerStatus"


def test_the_guide_shows_what_is_printed(tmp_path, capsys, monkeypatch):
    guide = (Path(__file__).parents[3] / "docs" / "testing.md").read_text(encoding="utf-8")
    shown = re.search(r"```text\n(first difference .*?)```", guide, re.DOTALL)
    played, replayed = (
        next(line.strip().split()[1:] for line in guide.splitlines() if line.strip().startswith(command))
        for command in ("hil run sine_load --log .blf --out before", "hil replay before/bus.blf --tuning")
    )
    monkeypatch.chdir(tmp_path)
    assert cli.main([*played, "--mode", "inprocess", "--duration", "0.1"]) == 0
    assert cli.main(replayed) == 1
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert shown is not None
    assert set(shown[1].splitlines()) <= set(printed)


def test_another_tuning_is_an_exit_code_and_a_picture(log, tmp_path):
    run = ["replay", str(log), "--tuning", "linear", "--controller", "adrc", "--out", str(tmp_path)]
    assert cli.main(run) == 1
    result = json.loads((tmp_path / "replay.json").read_text())
    assert (result["tuning"], result["controller"]) == ("linear", "adrc")
    assert result["messages"]["DriveCommand"]["first_difference"]["time_s"] < 0.1


def test_what_has_to_be_known_beside_the_figures_is_said(tmp_path, capsys):
    traffic = spoiled(faulty("PositionFeedback", FrameFault.DESTROY, 40, 3))
    traffic[:, 0] += 37_000
    path = tmp_path / "bus.log"
    write_bus_log(path, traffic)
    assert cli.main(["replay", str(path)]) == 0
    inferred, passed_over = capsys.readouterr().err.splitlines()
    assert "the timer's phase is inferred" in inferred
    assert passed_over == "hil: passed over, as no node takes them: 3 error frames"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere.log",), "nowhere.log: cannot be read"),
        (("{log}", "--tuning", "none"), "there is no tuning 'none'"),
        (("{log}", "--bitrate", "0"), "bit rate 0 is not from"),
        (("{log}", "--channel", "can7"), "no channel 'can7' is in it: choose one of can0"),
        (("{log}", "--dbc", "/nowhere/my.dbc"), "/nowhere/my.dbc: cannot be read"),
    ],
)
def test_wrong_input_is_refused_in_one_line(log, tmp_path, capsys, arguments, said):
    given = [argument.format(log=log) for argument in arguments]
    assert cli.main(["replay", *given, "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert said in line
    assert shown.out == ""
    assert not (tmp_path / "out").exists()


def test_a_log_that_begins_within_a_run_is_named(tmp_path, capsys):
    path = tmp_path / "part.log"
    write_bus_log(path, recorded()[2000:])
    assert cli.main(["replay", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hil: {path}: there is no BenchControl reset in the log")
