"""The firmware on an emulated processor is on the bus what the firmware in Python is."""

import importlib.util
import re
from pathlib import Path

import pytest
from bench_runs import hil, sha256, short_scenario

from dbc.contract import PACKAGED_DBC, Contract
from dbc.frame import Frame
from firmware_py.chosen_firmware import PROCESSORS, ChosenFirmware, FirmwareError, firmware_of_text
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.emulated.cycles import TABLES
from firmware_py.node import EXECUTION_NS
from firmware_py.state_machine import POWER_ON
from hil.run.inprocess import run_inprocess
from hil.run.lockstep import run_lockstep
from hil.run.options import RunOptions

CONTRACT = Contract.load()
EXECUTION_US = EXECUTION_NS / 1e3
SHORT = short_scenario(0.3, load=((0.1, -2000.0),))


def options(directory: Path, firmware: ChosenFirmware, controller: str = "adrc") -> RunOptions:
    return RunOptions(SHORT, controller, record_directory=directory, firmware=firmware)


@pytest.mark.parametrize("controller", ["p", "pi", "adrc", "pi_ff", "scheduled"])
def test_every_law_on_a_cortex_m4_sends_the_frames_of_the_one_in_python(tmp_path, controller):
    python, emulated = (
        run_inprocess(options(tmp_path, ChosenFirmware(name, execution_us=EXECUTION_US), controller))
        for name in ("python", "cortex-m4")
    )
    assert sha256(python) == sha256(emulated)
    for name, column in python.controller.items():
        assert (emulated.controller[name] == column).all(), name


@pytest.mark.parametrize("processor", PROCESSORS)
def test_every_processor_sends_the_same_frames_in_lockstep(tmp_path, processor):
    python = run_inprocess(options(tmp_path, ChosenFirmware()))
    firmware = ChosenFirmware(processor, execution_us=EXECUTION_US)
    assert sha256(run_lockstep(options(tmp_path, firmware))) == sha256(python)


def test_the_measured_execution_time_is_that_on_the_bus(tmp_path):
    firmware = ChosenFirmware("cortex-m0plus", clock_mhz=48.0)
    recording = run_inprocess(options(tmp_path, firmware))
    assert recording.execution_ns == firmware.execution_ns
    assumed = run_inprocess(options(tmp_path, ChosenFirmware()))
    ends = [
        run.traffic[run.traffic[:, 1] == CONTRACT.drive_command.can_id, 0] for run in (recording, assumed)
    ]
    assert int(ends[0][0]) - int(ends[1][0]) == firmware.execution_ns - EXECUTION_NS
    status = recording.traffic[recording.traffic[:, 1] == CONTRACT.controller_status.can_id][-1]
    share = CONTRACT.controller_status.unpack(int(status[3])).execution_time
    assert share == -(-firmware.execution_ns * 200 // 1_000_000)


def test_a_slower_clock_takes_longer():
    fast, slow = (ChosenFirmware("cortex-m4", clock_mhz=clock).execution_ns for clock in (168.0, 84.0))
    assert slow == pytest.approx(2 * fast, abs=2)


def test_a_damaged_calibration_keeps_the_processor_in_power_on():
    block = bytearray(chosen_tuning().calibration.to_bytes())
    block[40] ^= 1
    controller = ChosenFirmware("cortex-m4").controller(CONTRACT, bytes(block))
    controller.on_start(0)
    for period in range(10):
        controller.on_timer(period * 1_000_000)
    assert set(controller.record.columns_by_name()["state"]) == {POWER_ON}


def test_what_an_image_was_not_built_for_is_refused(tmp_path):
    text = PACKAGED_DBC.read_text(encoding="cp1252")
    other = tmp_path / "other.dbc"
    moved = re.sub(rf"\b(BO_|SG_|VAL_) {CONTRACT.drive_command.can_id} ", r"\1 300 ", text)
    other.write_text(moved, encoding="cp1252")
    contract = Contract.load(other)
    with pytest.raises(FirmwareError, match="built from the packaged DBC"):
        ChosenFirmware("cortex-m4").controller(contract, chosen_tuning().calibration.to_bytes())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"name": "z80"}, "there is no firmware 'z80': choose one of python, cortex-m0plus"),
        ({"clock_mhz": 48.0}, "a clock needs a processor"),
        ({"name": "cortex-m4", "clock_mhz": 0.0}, "a clock of 0 MHz is not from 1 to 1000"),
        ({"execution_us": -1.0}, "an execution time of -1 µs"),
        ({"execution_us": float("nan")}, "an execution time of nan µs"),
        ({"execution_us": float("inf")}, "an execution time of inf µs"),
        ({"execution_us": 500.0}, "is not below half a control period, 500 µs"),
        ({"name": "cortex-m0plus", "clock_mhz": 4.0}, "is not below half a control period"),
    ],
)
def test_what_cannot_run_is_refused_in_one_line(given, message):
    with pytest.raises(FirmwareError, match=message) as refused:
        ChosenFirmware(**given)
    assert "\n" not in str(refused.value)


def test_without_the_emulator_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FirmwareError, match=r"pip install '\.\[pil\]' in the project's folder"):
        ChosenFirmware("cortex-m4").controller(CONTRACT, b"")


def test_the_command_line_refuses_what_cannot_run(tmp_path):
    for text in ("z80", "python,clock_mhz=48", "cortex-m4,speed=3", "cortex-m4,clock_mhz=fast"):
        refused = hil("run", "sine", "--firmware", text, "--out", str(tmp_path / "out"))
        assert refused.returncode == 2
        assert len(refused.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("text", ["python", "cortex-m4", "cortex-m0plus,clock_mhz=64.0,execution_us=120.5"])
def test_a_firmware_is_what_its_text_says(text):
    assert firmware_of_text(text).text == text


def test_every_processor_has_its_cycles():
    assert tuple(TABLES) == PROCESSORS


def test_a_reset_from_the_bench_restarts_the_program():
    controller = ChosenFirmware("cortex-m3").controller(CONTRACT, chosen_tuning().calibration.to_bytes())
    controller.on_start(0)
    for period in range(5):
        controller.on_timer(period * 1_000_000)
    again = [controller.on_timer(5_000_000 + period * 1_000_000).sends[0][1] for period in range(2)]
    controller.on_start(7_000_000)
    fresh = [controller.on_timer(7_000_000 + period * 1_000_000).sends[0][1] for period in range(2)]
    assert isinstance(fresh[0], Frame)
    assert again != fresh
