"""Wrong input: one line that says what is wrong and what to do, exit code 2, nothing half-written."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest
from bench_runs import SAFETY_NET_S, alive, background, children, name_of, wait_until

from dbc.contract import PACKAGED_DBC
from firmware_py.__main__ import main as firmware_main
from hil import cli
from hil.bus import link
from hil.scenario import ScenarioError, load_scenario
from plant_sim.__main__ import main as plant_main


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run the command line in this process; it must refuse with one line, which is returned."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    lines = said.err.splitlines()
    assert len(lines) == 1, said.err
    assert lines[0].startswith("hil: ")
    return lines[0]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture(autouse=True)
def nothing_is_half_written(tmp_path: Path):
    yield
    left = [path for path in tmp_path.rglob("*") if path.name.startswith(".unfinished-")]
    assert left == []
    out = tmp_path / "out"
    assert not out.exists() or list(out.iterdir()) == []
    assert list(link.socket_directory().iterdir()) == []


# scenarios


def test_an_unknown_scenario(capsys, out):
    line = refused(capsys, "run", "sinus", "--out", out)
    assert "unknown scenario 'sinus'" in line
    assert "sine" in line
    assert "full_stroke" in line


def test_a_scenario_file_that_is_not_there(capsys, out, tmp_path):
    assert "no scenario file" in refused(capsys, "run", tmp_path / "none.toml", "--out", out)


GOOD = 'title = "t"\nreference = "sine"\nduration_s = 1.0\n'


FAULT = GOOD + '[[fault]]\nkind = "sensor_bias"\nbias_m = 0.1\n\n[[fault]]\n'


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("title = ", "Invalid value (at end of document)"),
        ("title = \x00", "Invalid value (at line 1, column 9)"),
        (GOOD + GOOD, "Cannot overwrite a value (at line 4"),
        ("", "missing key 'title'; needed are title, reference, duration_s"),
        (
            'title = "t"\nreference = "sine"\n',
            "line 1: missing key 'duration_s'; needed are title, reference",
        ),
        (GOOD + "speed = 1\n", "line 4: unknown key 'speed'; allowed are title, reference, duration_s, load"),
        (
            "# comment\n\n" + GOOD.replace('"sine"', '"cosine"'),
            "line 4: reference 'cosine' is not one of sine, lift_lower, full_stroke",
        ),
        (GOOD.replace('"sine"', '["sine"]'), "line 2: reference"),
        (GOOD.replace('"t"', "1"), "line 1: title is 1, must be a text"),
        (GOOD.replace("1.0", '"1.0"'), "line 3: duration_s is '1.0', must be from 0.001 to 3600 s"),
        (GOOD.replace("1.0", "0"), "line 3: duration_s is 0, must be from 0.001 to 3600 s"),
        (GOOD.replace("1.0", "nan"), "line 3: duration_s is nan"),
        (GOOD.replace("1.0", "true"), "line 3: duration_s is True"),
        (GOOD + "load = 5\n", "line 4: load must be a list of [time_s, force_n]"),
        (GOOD + "load = [\n[1.0]\n]\n", "line 4: load must be a list of [time_s, force_n]"),
        (GOOD + 'load = [["a", 1]]\n', "line 4: load must be a list of [time_s, force_n]"),
        (GOOD + "load = [[nan, 1]]\n", "line 4: load"),
        (GOOD + "load = [[1, inf]]\n", "line 4: load"),
        (
            GOOD + "load = [[0.5, 1e12]]\n",
            "line 4: load must be a list of [time_s, force_n], from 0 s on",
        ),
        (GOOD + "load = [[-1, 5]]\n", "line 4: load"),
        (GOOD + "limits = 3\n", "line 4: limits is 3, must be a table by controller: p, pi, adrc"),
        (GOOD + "[limits]\nadrc = 3\n", "line 5: limits.adrc is 3, must be a table with rms_mm and max_mm"),
        (GOOD + "[limits.pid]\nrms_mm = 1\nmax_mm = 1\n", "line 4: limits.pid must be one of p, pi, adrc"),
        (
            GOOD + "[limits.adrc]\nrms_mm = 1\n",
            "line 4: missing key 'max_mm' in limits.adrc; needed are",
        ),
        (
            GOOD + "[limits.adrc]\nrms_mm = 1\nmax_mn = 1\n",
            "line 6: unknown key 'max_mn' in limits.adrc; allowed",
        ),
        (
            GOOD + '[limits.adrc]\nrms_mm = "a"\nmax_mm = 1\n',
            "line 5: limits.adrc.rms_mm is 'a', must be a",
        ),
        (
            GOOD + "[paper.adrc]\nrms_mm = 1\nmax_mm = []\n",
            "line 6: paper.adrc.max_mm is [], must be a",
        ),
        (
            GOOD + "timing = 3\n",
            "line 4: timing is 3, must be a table of limits: feedback_age_us",
        ),
        (
            GOOD + "[timing]\nlatency = 3\n",
            "line 5: unknown key 'latency' in timing; allowed are feedback_age",
        ),
        (
            GOOD + "timing.latency_us = -3\n",
            "line 4: timing.latency_us is -3, must be a number of µs",
        ),
        (GOOD + "machine = 3\n", "line 4: machine is 3, must be a table"),
        (GOOD + "[machine]\nmas = 1\n", "line 5: machine: there is no 'mas', only mass, bulk_modulus"),
        (
            GOOD + "[machine]\nleak = 1\nmass = 99\n",
            "line 6: machine: mass is 99, must be a number from 0.1 to 10 times nominal",
        ),
        (
            GOOD + "[machine]\ndelay_periods = 1.5\n",
            "line 5: machine: delay_periods is 1.5, must be a whole number",
        ),
        (GOOD + "[fault]\n", "line 4: fault is no list: write each as a table [[fault]]"),
        (GOOD + "fault = [1]\n", "line 4: fault[0] is 1, must be a table"),
        (
            FAULT + "bias_m = 0.1\n",
            "line 8: missing key 'kind': it is one of drop, delay",
        ),
        (FAULT + 'kind = "bias"\n', "line 9: there is no fault 'bias': choose one of drop, delay, duplicate"),
        (FAULT + "kind = 3\n", "line 9: there is no fault 3: choose one of drop, delay, duplicate"),
        (
            FAULT + 'kind = "sensor_bias"\n',
            "line 8: sensor_bias: bias_m is missing, must be a number",
        ),
        (
            FAULT + 'kind = "sensor_bias"\nbias_m = 0\nbias = 1\n',
            "line 11: sensor_bias: there is no 'bias', only at_s, duration_s, bias_m",
        ),
        (
            FAULT + 'kind = "sensor_bias"\nbias_m = "a lot"\n',
            "line 10: sensor_bias: bias_m is 'a lot', must be a number from -1 to 1 m",
        ),
        (
            FAULT + 'kind = "drop"\nmessage = "Position"\n',
            "line 10: drop: message is 'Position', must be one of DriveCommand, PositionFeedback",
        ),
        (
            FAULT + 'kind = "drop"\nmessage = "DriveCommand"\ncount = 1.5\n',
            "line 11: drop: count is 1.5, must be a whole number from 1 to 1000000 frames",
        ),
        (
            FAULT + 'kind = "signal_offset"\nmessage = "DriveCommand"\nsignal = "Position"\noffset = 1\n',
            "line 11: signal_offset: DriveCommand has no signal 'Position': choose one of Controlword",
        ),
    ],
)
def test_a_malformed_scenario_file(capsys, out, tmp_path, text, what):
    """The line, the key, and what is allowed; a key that is missing at the top has no line."""
    file = tmp_path / "mine.toml"
    file.write_text(text)
    line = refused(capsys, "run", file, "--mode", "inprocess", "--out", out)
    assert f"mine.toml: {what}" in line


def test_a_scenario_file_that_is_no_text(capsys, out, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_bytes(b"\xff\xfe\x00\x01")
    assert "mine.toml" in refused(capsys, "run", file, "--out", out)


@pytest.mark.parametrize("duration", ["0", "-1", "nan", "inf", "1e9"])
def test_a_duration_that_makes_no_sense(capsys, out, duration):
    assert "duration_s" in refused(capsys, "run", "sine", f"--duration={duration}", "--out", out)


# machine and tuning

MACHINE_AND_TUNING = [
    (["--machine", "mass"], "machine: 'mass' is not of the form KEY=VALUE"),
    (["--machine", "delay_periods=4"], "machine: delay_periods is 4.0, must be a whole number from 1 to 3"),
    (["--tuning", "best"], "there is no tuning 'best': choose one of paper"),
    (["--calibration", "none.bin"], "cannot read calibration file none.bin (No such file or directory)"),
    (["--calibration", __file__], "test_bad_input.py: calibration: magic"),
    (["--tuning", "paper", "--calibration", __file__], "exclude each other"),
]


@pytest.mark.parametrize(("arguments", "what"), MACHINE_AND_TUNING)
def test_a_machine_or_tuning_that_is_none(capsys, out, arguments, what):
    assert what in refused(capsys, "run", "sine", *arguments, "--out", out)


@pytest.mark.parametrize(("arguments", "what"), MACHINE_AND_TUNING)
def test_a_single_side_refuses_it_too(capsys, arguments, what):
    side = plant_main if arguments[0] == "--machine" else firmware_main
    assert side(["-i", "hilbus", "-c", "none", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert what in line


def test_scenario_errors_are_value_errors_for_those_who_use_the_library():
    with pytest.raises(ScenarioError):
        load_scenario("sinus")
    assert issubclass(ScenarioError, ValueError)


# the contract

MODES = ("inprocess", "lockstep", "realtime")


@pytest.mark.parametrize("mode", MODES)
def test_a_dbc_that_misses_a_message(capsys, out, tmp_path, mode):
    dbc = tmp_path / "short.dbc"
    blocks = PACKAGED_DBC.read_text().split("\n\n")
    kept = [block for block in blocks if not block.startswith("BO_ 288 ")]
    assert len(kept) == len(blocks) - 1
    dbc.write_text("\n\n".join(line_without(block, " 288 ") for block in kept))
    line = refused(capsys, "run", "sine", "--mode", mode, "--dbc", dbc, "--out", out)
    assert "short.dbc: message PositionSetpoint is missing: add it" in line


def line_without(block: str, text: str) -> str:
    return "\n".join(line for line in block.splitlines() if text not in line)


@pytest.mark.parametrize("content", [b"not a dbc", b"\xff\x00"])
def test_a_dbc_that_is_none(capsys, out, tmp_path, content):
    dbc = tmp_path / "broken.dbc"
    dbc.write_bytes(content)
    assert "broken.dbc" in refused(capsys, "run", "sine", "--dbc", dbc, "--out", out)


def test_a_dbc_that_is_not_there(capsys, out):
    line = refused(capsys, "run", "sine", "--dbc", "/nowhere/my.dbc", "--out", out)
    assert "/nowhere/my.dbc: cannot be read" in line


@pytest.mark.parametrize("module", ["plant_sim", "firmware_py"])
def test_a_single_side_refuses_a_bad_dbc_too(tmp_path, module):
    dbc = tmp_path / "broken.dbc"
    dbc.write_text("not a dbc")
    with background(module, "-i", "hilbus", "-c", "test", "--dbc", str(dbc)) as side:
        _, said = side.communicate(timeout=SAFETY_NET_S)
    assert side.returncode == 2
    assert said.count("\n") == 1
    assert "not a valid DBC" in said


# where the results go


@pytest.mark.parametrize("mode", MODES)
def test_an_out_directory_that_cannot_be_written(capsys, tmp_path, mode):
    file = tmp_path / "file"
    file.write_text("")
    line = refused(capsys, "run", "sine", "--mode", mode, "--out", file / "deeper")
    assert f"cannot write to {file / 'deeper'}" in line
    assert "choose another --out" in line


def test_an_out_directory_that_is_a_file(capsys, tmp_path):
    file = tmp_path / "file"
    file.write_text("keep me")
    assert "cannot write" in refused(capsys, "run", "sine", "--out", file)
    assert file.read_text() == "keep me"


def test_a_refused_run_does_not_touch_earlier_results(capsys, out):
    out.mkdir()
    (out / "result.json").write_text("{}")
    refused(capsys, "run", "sine", "--dbc", "/nowhere/my.dbc", "--out", out)
    assert [file.name for file in out.iterdir()] == ["result.json"]
    (out / "result.json").unlink()


def test_a_refused_run_does_not_leave_the_folder_it_made(capsys, out):
    refused(capsys, "run", "sine", "--dbc", "/nowhere/my.dbc", "--out", out)
    assert not out.exists()


@pytest.mark.parametrize("suffix", [".xyz", "log", ""])
def test_an_unknown_log_suffix(capsys, out, suffix):
    line = refused(capsys, "run", "sine", "--log", suffix, "--out", out)
    assert f"no bus log can be written as {suffix!r}: choose one of" in line


WITHOUT_ASAMMDF = "import sys; sys.modules['asammdf'] = None; from hil.cli import main; sys.exit(main())"


@pytest.mark.parametrize("command", [("run", "sine", "--log", ".mf4"), ("replay", "bus.mf4")])
def test_a_log_format_whose_package_is_missing_is_refused_before_the_run(out, command):
    refused = subprocess.run(
        [sys.executable, "-c", WITHOUT_ASAMMDF, *command, "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=SAFETY_NET_S,
    )
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == "hil: .mf4 needs asammdf: pip install '.[mf4]' in the project's folder\n"
    assert not out.exists()


# the bus


@pytest.mark.parametrize("bit_rate", ["0", "-1", "9999", "1000001"])
@pytest.mark.parametrize("command", [("run", "sine"), ("bus", "--channel", "test")], ids=["run", "bus"])
def test_a_bit_rate_that_classic_can_does_not_have(capsys, command, bit_rate):
    line = refused(capsys, *command, f"--bitrate={bit_rate}")
    assert f"bit rate {bit_rate} is not from 10000 to 1000000 bit/s" in line


def test_an_interface_in_virtual_time(capsys, out):
    line = refused(capsys, "run", "sine", "-i", "socketcan", "-c", "vcan0", "--out", out)
    assert "--interface needs --mode realtime" in line


def test_a_pace_in_virtual_time(capsys, out):
    line = refused(capsys, "run", "sine", "--rt-ratio", "0.1", "--out", out)
    assert "--rt-ratio needs --mode realtime" in line


def test_an_interface_without_a_channel(capsys, out):
    line = refused(capsys, "run", "sine", "--mode", "realtime", "-i", "socketcan", "--out", out)
    assert "no channel for socketcan: give -i and -c" in line


def test_an_interface_that_does_not_exist(capsys, out):
    line = refused(capsys, "run", "sine", "--mode", "realtime", "-i", "nosuch", "-c", "x", "--out", out)
    assert "nosuch" in line


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_channel_name_that_cannot_be(capsys, out, mode):
    assert "channel name 'a/b'" in refused(capsys, "run", "sine", "--mode", mode, "-c", "a/b", "--out", out)


def test_a_second_firmware_on_the_same_channel():
    with background("hil", "bus", "--channel", "test") as bus:
        assert "hilbus channel 'test'" in bus.stdout.readline()
        with background("firmware_py", "-i", "hilbus", "-c", "test") as first:
            assert "controller is on" in first.stderr.readline()
            with background("firmware_py", "-i", "hilbus", "-c", "test") as second:
                _, said = second.communicate(timeout=SAFETY_NET_S)
            assert second.returncode == 2
            assert said.count("\n") == 1
            assert "has a controller already: stop it or choose another channel" in said
            assert first.poll() is None
            first.send_signal(signal.SIGINT)
            first.communicate(timeout=SAFETY_NET_S)
            assert first.returncode == 0
        bus.send_signal(signal.SIGTERM)
        bus.communicate(timeout=SAFETY_NET_S)
        assert bus.returncode == 0


def test_a_second_firmware_during_a_lockstep_run(tmp_path):
    """The run is not disturbed; the one who comes late is told."""
    scenario = tmp_path / "long.toml"
    scenario.write_text(GOOD.replace("1.0", "3600"))
    with background("hil", "run", str(scenario), "-c", "test", "--out", str(tmp_path / "elsewhere")) as bench:
        sides = wait_until(lambda: len(children(bench.pid)) == 2 and children(bench.pid), "the sides start")
        listen_until_frames_come("test")
        with background("firmware_py", "-i", "hilbus", "-c", "test") as second:
            _, said = second.communicate(timeout=SAFETY_NET_S)
        assert (second.returncode, said.count("\n")) == (2, 1)
        assert "has a controller already" in said
        assert bench.poll() is None
        bench.send_signal(signal.SIGINT)
        bench.communicate(timeout=SAFETY_NET_S)
        assert bench.returncode == 130
    wait_until(lambda: not any(alive(pid) for pid in sides), "no process is left")


# a side that hangs


def test_a_plant_that_never_answers(tmp_path, out):
    scenario = tmp_path / "long.toml"
    scenario.write_text(GOOD.replace("1.0", "3600"))
    command = ["run", str(scenario), "--out", str(out), "-c", "test", "--answer-timeout", "1"]
    with background("hil", *command) as bench:
        (plant,) = wait_until(
            lambda: [pid for pid in children(bench.pid) if name_of(pid) == "hil-plant"],
            "the plant starts",
        )
        sides = children(bench.pid)
        listen_until_frames_come("test")
        os.kill(plant, signal.SIGSTOP)
        _, said = bench.communicate(timeout=SAFETY_NET_S)
    assert bench.returncode == 2
    assert said.count("\n") == 1
    assert "the plant process did not answer for 1 s at bus time" in said
    assert "--answer-timeout" in said
    wait_until(lambda: not any(alive(pid) for pid in sides), "no process is left")


def listen_until_frames_come(channel: str) -> None:
    def bus() -> can.BusABC | None:
        try:
            return can.Bus(interface="hilbus", channel=channel)
        except can.CanInitializationError:
            return None

    with wait_until(bus, "the hub is there") as listener:
        assert listener.recv(SAFETY_NET_S) is not None


def test_sides_that_do_not_come_up_in_time(capsys, out):
    line = refused(capsys, "run", "sine", "--start-timeout", "0.001", "--out", out)
    assert "did not come up within 0.001 s: raise --start-timeout" in line


@pytest.mark.parametrize("option", ["--start-timeout", "--answer-timeout"])
@pytest.mark.parametrize("value", ["0", "-1", "x", "nan"])
def test_a_timeout_that_is_no_time(capsys, option, value):
    assert option in refused_by_the_parser(capsys, "run", "sine", f"{option}={value}")


@pytest.mark.parametrize("value", ["0", "-1", "2", "x", "1/0"])
def test_a_ratio_that_is_none(capsys, value):
    assert "--rt-ratio" in refused_by_the_parser(capsys, "run", "sine", f"--rt-ratio={value}")


def test_no_command_at_all(capsys):
    assert "COMMAND" in refused_by_the_parser(capsys)


def refused_by_the_parser(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Wrong usage shows the usage, too; return the line that says what is wrong."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert ended.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]
