"""Faults in scenarios, tests, real time and running benches: always the same ones at the same time."""

import json
import signal
import socket
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, background, serving, sha256, short_scenario, wait_until
from bit_by_bit import reference_bits

from dbc.contract import Contract
from dbc.messages import BenchCommand, BenchFault
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.node import PHASE_NS
from hil import cli
from hil.bench import Bench
from hil.bus import link
from hil.bus.messages import to_message
from hil.closed_loop import play_closed_loop
from hil.faults.catalogue import KINDS, fault_of_text
from hil.faults.fault import FaultError
from hil.inject_command import take_faults
from hil.run.inprocess import InprocessRig, run_inprocess
from hil.run.lockstep import run_lockstep
from hil.run.options import BenchError, Recording, RigOptions, RunOptions
from hil.run.realtime_rig import RealtimeRig
from hil.scenario import Scenario, ScenarioError, load_scenario

CONTRACT = Contract.load()
ALL_KINDS = Path(__file__).parent / "all_kinds.toml"
REPEATS = 100


@pytest.fixture
def rig() -> Iterator[InprocessRig]:
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        yield rig


def played(directory: Path, scenario: Scenario, run=run_inprocess, **options) -> Recording:
    return run(RunOptions(scenario, record_directory=directory, **options))


# one hash


def test_the_scenario_has_faults_of_all_kinds_and_they_matter(tmp_path):
    scenario = load_scenario(str(ALL_KINDS))
    assert {fault.kind for fault in scenario.faults} == set(KINDS)
    hashes = {sha256(played(tmp_path, scenario))}
    for fault in scenario.faults:
        others = tuple(other for other in scenario.faults if other is not fault)
        hashes.add(sha256(played(tmp_path, replace(scenario, faults=others))))
    assert len(hashes) == 1 + len(scenario.faults), "leaving any of them out makes another run"


def test_repeats_and_lockstep_give_one_hash(tmp_path):
    scenario = load_scenario(str(ALL_KINDS))
    apart = played(tmp_path, scenario, run_lockstep)
    assert {sha256(played(tmp_path, scenario)) for _ in range(4)} == {sha256(apart)}
    assert apart.notes["injected_faults"] == []


@pytest.mark.long
def test_a_hundred_repeats_give_one_hash(tmp_path):
    scenario = load_scenario(str(ALL_KINDS))
    assert len({sha256(played(tmp_path, scenario)) for _ in range(REPEATS)}) == 1


# the same from everywhere

FAULTS = (
    "drop,message=PositionFeedback,count=2,at_s=0.05",
    "signal_offset,message=PositionSetpoint,signal=Position,offset=0.001,count=30,at_s=0.06",
    "late_period,late_us=250,count=3,at_s=0.0702",
    "load_step,force_n=-2000,duration_s=0.05,at_s=0.1",
)


def test_file_command_line_and_test_play_the_same(tmp_path, rig, capsys):
    file = tmp_path / "mine.toml"
    text = 'title = "t"\nreference = "sine"\nduration_s = 0.3\n'
    for fault in map(fault_of_text, FAULTS):
        keys = (f"{key} = {json.dumps(value)}\n" for key, value in fault.table.items())
        text += "".join(["[[fault]]\n", *keys])
    file.write_text(text)
    bench = Bench(rig)
    bench.setpoint(short_scenario().position_m)
    bench.run(0.02)
    for fault in map(fault_of_text, FAULTS):
        bench.inject(replace(fault, at_s=round(fault.at_s - 0.02, 9)))
    bench.run(0.28)

    given = [argument for fault in FAULTS for argument in ("--fault", fault)]
    command = ["run", "sine", "--duration", "0.3", "--mode", "inprocess", "--json", *given]
    assert cli.main([*command, "--out", str(tmp_path / "out")]) == 0
    result = json.loads(capsys.readouterr().out)
    from_file = played(tmp_path, load_scenario(str(file)))
    assert result["bus_sha256"] == sha256(from_file) == sha256(bench.recording)
    assert result["bus_sha256"] != sha256(played(tmp_path, short_scenario(0.3)))
    tables = [fault_of_text(fault).table for fault in FAULTS]
    assert result["faults"] == tables
    assert result["reproducible"] is True
    times_s = [fault["at_s"] for fault in bench.result("x")["faults"]]
    assert times_s == pytest.approx([0.05, 0.06, 0.0702, 0.1])


def test_a_fault_begins_at_its_nanosecond(rig):
    bench = Bench(rig)
    bench.run(0.01)
    bench.inject("babble", at_s=0.000_999_999, duration_s=1e-4)
    bench.inject("reset", at_s=0.005_5, node="controller")
    bench.run(0.02)
    traffic = bench.recording.traffic
    babbled_ns = traffic[traffic[:, 1] == 0][0, 0] - bench.recording.start_ns
    bits = int(reference_bits(np.zeros(1, np.uint64), False, 8, np.zeros(1, np.uint64))[0]) - 3
    assert int(babbled_ns) == 10_999_999 + bits * 1000, "at once, the bus being idle"
    called_ns = bench.recording.controller["time_ns"] - bench.recording.start_ns + PHASE_NS
    assert 15_500_000 in called_ns, "a reset comes before the timer at that time, and the timer comes then"


def test_what_comes_too_late_for_the_scenario_is_refused(tmp_path, capsys):
    file = tmp_path / "mine.toml"
    file.write_text(
        'title = "t"\nreference = "sine"\nduration_s = 0.3\n[[fault]]\nkind = "reset"\nat_s = 0.3\n'
    )
    assert cli.main(["run", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "line 6: reset: at_s is 0.3, must be below duration_s, 0.3 s" in capsys.readouterr().err
    file.write_text(file.read_text().replace("at_s = 0.3", "at_s = 0.25"))
    assert len(load_scenario(str(file)).faults) == 1
    assert load_scenario(str(file), 0.2).faults == (), "cut short"
    late = ["run", "sine", "--duration", "1", "--fault", "reset,at_s=1", "--out", str(tmp_path / "out")]
    assert cli.main(late) == 2
    assert "reset: at_s is 1.0, must be below duration_s, 1 s" in capsys.readouterr().err


def test_too_many_faults_at_a_time_end_the_run_with_one_line(tmp_path, capsys):
    given = ["--fault", "drop,message=ControllerStatus,count=1000,at_s=0.1"] * 65
    command = ["run", "sine", "--duration", "0.2", "--mode", "inprocess", "--out", str(tmp_path / "out")]
    assert cli.main([*command, *given]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "hil: at bus time 0.200000 s: there is room for 64 faults at a time"


def test_a_sweep_refuses_a_scenario_with_faults(capsys):
    assert cli.main(["sweep", str(ALL_KINDS)]) == 2
    assert "all_kinds has faults, which need the bus" in capsys.readouterr().err
    with pytest.raises(ScenarioError, match="all_kinds has faults, which need the bus"):
        play_closed_loop(load_scenario(str(ALL_KINDS)), chosen_tuning().calibration)


# real time


def test_in_real_time_what_needs_a_simulated_wire_is_refused(tmp_path, capsys):
    command = ["run", "sine", "--mode", "realtime", "--out", str(tmp_path / "out")]
    assert cli.main([*command, "--fault", "sensor_stuck", "--fault", "reset,at_s=1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "hil: the fault reset,at_s=1.0 needs virtual time: use --mode inprocess or lockstep"


def test_in_real_time_sensor_and_load_do_what_they_are_told(tmp_path):
    options = RigOptions(record_directory=tmp_path, rt_ratio=Fraction(1, 5))
    with RealtimeRig(options) as rig:
        bench = Bench(rig)
        with pytest.raises(FaultError, match="drop needs virtual time"):
            bench.drop("PositionFeedback")
        bench.inject("sensor_bias", bias_m=0.25)
        bench.inject("load_step", force_n=-700)
        bench.run(0.2)
        shown = bench.signal("PositionFeedback.Position")
        assert shown.last == pytest.approx(0.25, abs=0.05)
        loads = [CONTRACT.bench_load.unpack(int(data)).force for data in sent_on(bench, "BenchLoad")]
        assert loads[-1] == -700
        assert [fault["kind"] for fault in bench.result("x")["faults"]] == ["sensor_bias", "load_step"]


def test_a_plant_whose_sensor_is_silent_still_runs(tmp_path):
    rig = RealtimeRig(RigOptions(record_directory=tmp_path))
    feedback, status, command = (
        message.can_id
        for message in (CONTRACT.position_feedback, CONTRACT.drive_status, CONTRACT.drive_command)
    )
    now_ns = time.monotonic_ns()
    long_ago_ns = now_ns - 10**11

    def check_after(heard_ns: dict[int, int]) -> None:
        rig.listener = SimpleNamespace(newest_ns=heard_ns)
        rig.check_sides()

    check_after({feedback: long_ago_ns, status: now_ns, command: now_ns})
    check_after({feedback: now_ns, command: now_ns})  # the slower message is not heard yet
    with pytest.raises(BenchError, match="the plant has been silent for 100"):
        check_after({feedback: long_ago_ns, status: long_ago_ns, command: now_ns})


def sent_on(bench: Bench, message: str) -> list[int]:
    traffic = bench.recording.traffic
    return traffic[traffic[:, 1] == CONTRACT.message(message).can_id][:, 3].tolist()


# into a running bench


def ask_for(channel: str, fault: str) -> socket.socket:
    """Ask a hub for a fault without waiting for the answer: the hub may be busy in this very thread."""
    asking = link.seqpacket_socket()
    asking.connect(str(link.socket_path(channel)))
    link.send_json(
        asking, {"version": link.PROTOCOL_VERSION, "role": "fault", "fault": fault_of_text(fault).table}
    )
    return asking


@pytest.mark.parametrize("fault", ["drop,message=PositionFeedback,count=5", "load_step,force_n=-900"])
def test_a_fault_injected_live_is_on_record_so_that_it_can_be_played_again(tmp_path, fault):
    asked: list[socket.socket] = []

    def progress(simulated_s: float) -> None:
        if not asked:
            asked.append(ask_for("live", fault))

    scenario = short_scenario(0.5)
    live = played(tmp_path, scenario, run_lockstep, channel="live", progress=progress)
    answer = link.receive_json(asked[0])
    asked[0].close()
    (table,) = live.notes["injected_faults"]
    assert answer["bus_time_s"] == pytest.approx(table["at_s"] + live.start_ns / 1e9)
    assert sha256(live) != sha256(played(tmp_path, scenario))
    again = replace(scenario, faults=(fault_of_text(fault + f",at_s={table['at_s']!r}"),))
    assert sha256(live) == sha256(played(tmp_path, again))


def test_hil_inject_into_a_lockstep_run(tmp_path, capsys):
    scenario = tmp_path / "long.toml"
    scenario.write_text('title = "t"\nreference = "sine"\nduration_s = 3600\n')
    with background("hil", "run", str(scenario), "-c", "test", "--out", str(tmp_path / "out")) as bench:
        said = wait_until(lambda: told(capsys, "test", "sensor_bias,bias_m=0.001"), "the run takes a fault")
        assert said.startswith("sensor_bias,at_s=0.0,bias_m=0.001 at bus time ")
        assert cli.main(["inject", "test", "cut_off,node=controller,at_s=0.5", "leak,factor=3"]) == 0
        assert cli.main(["inject", "test", "cut_off,node=drive"]) == 2
        bench.send_signal(signal.SIGINT)
        bench.communicate(timeout=SAFETY_NET_S)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [fault["kind"] for fault in result["faults"]] == ["sensor_bias", "cut_off", "leak"]
    assert result["reproducible"] is False
    assert f"{result['faults'][0]['at_s'] + result['scenario_start_bus_s']:.6f} s" in said


def test_what_is_injected_into_a_real_time_run_is_on_record(tmp_path):
    options = RigOptions(record_directory=tmp_path, rt_ratio=Fraction(1, 5), channel="live")
    with RealtimeRig(options) as rig, can.Bus(interface="hilbus", channel="live") as other:
        assert cli.main(["inject", "live", "sensor_noise,rms_m=1e-6"]) == 0
        bench = Bench(rig)
        bench.inject("load_step", force_n=-700)
        bench.run(0.1)
        assert bench.result("x")["notes"]["injections"] == [], "what the bench does itself is none"
        begin_s = bench.time_s
        assert cli.main(["inject", "live", "sensor_bias,bias_m=0.25", "drop,message=DriveStatus,at_s=1"]) == 0
        bench.run(0.2)
        load = CONTRACT.bench_load.frame(CONTRACT.bench_load.pack(-900))
        other.send(to_message(0, load, "live"))
        bench.run(0.4)
        result, end_s = bench.result("x"), bench.time_s
    own, bias, drop = result["faults"]
    assert own["kind"] == "load_step"
    assert bias == {"kind": "sensor_bias", "bias_m": 0.25, "at_s": bias["at_s"]}
    assert begin_s <= bias["at_s"] <= end_s
    assert drop == {"kind": "drop", "message": "DriveStatus", "at_s": drop["at_s"]}
    assert begin_s + 0.2 <= drop["at_s"] <= end_s + 0.2, "1 s of wall time later, at a ratio of 1/5"
    (bias_s, *bias_frame), (load_s, *load_frame) = result["notes"]["injections"]
    control = CONTRACT.bench_control.unpack(bias_frame[2])
    assert control == (BenchCommand.SET_FAULT, BenchFault.SENSOR_BIAS, 250_000)
    assert load_frame == list(load)
    assert (
        begin_s <= bias_s - result["scenario_start_bus_s"] <= load_s - result["scenario_start_bus_s"] <= end_s
    )


def told(capsys: pytest.CaptureFixture[str], channel: str, fault: str) -> str:
    code = cli.main(["inject", channel, fault])
    said = capsys.readouterr()
    return said.out if code == 0 else ""


def test_hil_inject_into_hil_bus(capsys):
    with serving("test") as hub, can.Bus(interface="hilbus", channel="test") as one:
        take_faults(hub)
        with can.Bus(interface="hilbus", channel="test") as other:
            can_id = CONTRACT.drive_command.can_id
            assert cli.main(["inject", "test", "drop,message=DriveCommand"]) == 0
            one.send(can.Message(arbitration_id=can_id, data=b"1", is_extended_id=False))
            one.send(can.Message(arbitration_id=can_id, data=b"2", is_extended_id=False))
            assert bytes(other.recv(SAFETY_NET_S).data) == b"2"
            assert cli.main(["inject", "test", "sensor_stuck,duration_s=0.01"]) == 0
            assert [control_in(other) for _ in range(2)] == [
                (BenchCommand.SET_FAULT, BenchFault.SENSOR_STUCK, 1_000_000),
                (BenchCommand.SET_FAULT, BenchFault.SENSOR_STUCK, 0),
            ]
        capsys.readouterr()
        assert cli.main(["inject", "test", "reset"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line == "hil: reset needs the controller in virtual time: inject it into a lock-step run"


def test_hil_inject_on_another_interface(capsys):
    with can.Bus(interface="virtual", channel="shop floor") as plant:
        where = ["inject", "shop floor", "-i", "virtual"]
        faults = ["load_step,force_n=-5,duration_s=0.002", "load_step,force_n=3,at_s=0.001"]
        assert cli.main([*where, *faults]) == 0
        unpack = CONTRACT.bench_load.unpack
        received = [plant.recv(SAFETY_NET_S) for _ in range(3)]
        assert [unpack(int.from_bytes(message.data, "little")).force for message in received] == [-5, -2, 3]
        assert cli.main([*where, "bus_off,node=plant"]) == 2
    assert "bus_off needs a simulated wire: virtual has none" in capsys.readouterr().err


def test_an_interrupted_fault_is_ended_at_once(monkeypatch):
    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hil.inject_command.time.sleep", interrupt)
    with can.Bus(interface="virtual", channel="shop floor") as plant:
        assert cli.main(["inject", "shop floor", "-i", "virtual", "sensor_stuck,duration_s=1000"]) == 0
        assert [control_in(plant)[2] for _ in range(2)] == [1_000_000, 0]


def control_in(bus: can.BusABC) -> tuple[int, int, int]:
    message = bus.recv(SAFETY_NET_S)
    return CONTRACT.bench_control.unpack(int.from_bytes(message.data, "little"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nobody", "reset"], "no hub on hilbus channel 'nobody': start one"),
        (["test", "resets"], "there is no fault 'resets': choose one of drop"),
        (["a/b", "reset"], "channel name 'a/b'"),
        (["test", "reset", "--dbc", "my.dbc"], "--dbc my.dbc: on hilbus the bench that runs has its own"),
        (["test", "reset", "-b", "500000"], "--bitrate 500000: on hilbus the bench that runs has its own"),
    ],
)
def test_hil_inject_refuses_in_one_line(capsys, arguments, said):
    assert cli.main(["inject", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_hub_without_a_run_takes_no_fault(hub, capsys):
    assert cli.main(["inject", "test", "reset"]) == 2
    assert "nothing runs on this channel yet" in capsys.readouterr().err


def test_the_scenario_file_is_what_it_says():
    assert len(tomllib.loads(ALL_KINDS.read_text())["fault"]) >= 20
