"""Virtual time: the same run gives the same frames at the same nanoseconds, whatever the machine does."""

import json
import threading
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, busy_machine, hil, sha256, short_scenario

from dbc.contract import Contract
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.tuning import TUNINGS
from hil.bus import link
from hil.bus.link import LinkError
from hil.run.inprocess import run_inprocess
from hil.run.lockstep import run_lockstep
from hil.run.options import INTERRUPTED, Recording, RunOptions
from hil.scenario import Scenario
from plant_sim.machine import Machine

CONTRACT = Contract.load()
SINE = short_scenario(1.0)
SINE_LOAD = short_scenario(1.0, load=((0.4, -2000.0), (0.7, 500.0)))


def options(directory: Path, scenario: Scenario = SINE, **given) -> RunOptions:
    return RunOptions(scenario, record_directory=directory, **{"controller": "adrc"} | given)


@pytest.fixture(scope="module")
def hashes() -> Callable[[Scenario], str]:
    """What the runs of this module must come to: hash of the in-process run."""
    known = {}

    def hash_of(scenario: Scenario) -> str:
        key = scenario.load
        if key not in known:
            known[key] = sha256(run_inprocess(options(Path(), scenario)))
        return known[key]

    return hash_of


def test_twenty_repeats_in_process_give_one_hash(hashes):
    short = replace(SINE, duration_s=0.2)
    assert len({sha256(run_inprocess(options(Path(), short))) for _ in range(20)}) == 1


def test_a_load_step_changes_the_run(hashes):
    assert hashes(SINE) != hashes(SINE_LOAD)


@pytest.mark.parametrize("scenario", [SINE, SINE_LOAD], ids=["sine", "sine_load"])
def test_lockstep_gives_the_same_frames_as_one_process(tmp_path, scenario, hashes):
    here = run_inprocess(options(tmp_path, scenario))
    apart = run_lockstep(options(tmp_path, scenario))
    assert np.array_equal(here.traffic, apart.traffic)
    assert sha256(apart) == hashes(scenario)
    for name in ("supervisor", "plant", "controller"):
        one, other = getattr(here, name), getattr(apart, name)
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[column], other[column]) for column in one)


def test_on_another_machine_under_another_calibration_too(tmp_path):
    block = tmp_path / "mine.bin"
    block.write_bytes(TUNINGS["pi_star"].calibration().to_bytes())
    heavy = replace(SINE, duration_s=0.3, machine=Machine(mass=1.5, delay_periods=3, position_lsb_um=10))
    given = options(tmp_path, heavy, controller="", tuning=chosen_tuning(file=block))
    apart = run_lockstep(given)
    assert sha256(apart) == sha256(run_inprocess(given))
    assert (apart.controller["position_um"] % 10 == 0).all()
    nominal = options(tmp_path, replace(heavy, machine=Machine()), controller="", tuning=given.tuning)
    assert sha256(apart) != sha256(run_inprocess(nominal))


def test_at_another_bit_rate_too(tmp_path):
    short = replace(SINE, duration_s=0.2)
    here = run_inprocess(options(tmp_path, short, bit_rate=400_000))
    apart = run_lockstep(options(tmp_path, short, bit_rate=400_000))
    assert sha256(here) == sha256(apart)


@pytest.mark.parametrize(
    ("machine", "hash_seed"),
    [(nullcontext, "1234"), (busy_machine, "random")],
    ids=["seed 1234", "busy"],
)
def test_neither_hash_seed_nor_load_changes_a_lockstep_run(tmp_path, monkeypatch, machine, hash_seed, hashes):
    monkeypatch.setenv("PYTHONHASHSEED", hash_seed)
    with machine():
        assert sha256(run_lockstep(options(tmp_path))) == hashes(SINE)


def test_the_hash_seed_does_not_change_a_run_in_one_process(tmp_path, hashes):
    command = ["run", "sine", "--controller", "adrc", "--mode", "inprocess", "--duration", "1", "--json"]
    command += ["--out", str(tmp_path)]
    ended = hil(*command, PYTHONHASHSEED="4321")
    assert json.loads(ended.stdout)["bus_sha256"] == hashes(SINE)


# observers and intruders


def with_program(given: RunOptions, program: Callable[[can.BusABC, threading.Event], None]) -> Recording:
    """Run in lock-step with a python-can program attached from a thread.

    The run starts when the program has attached, and its bus is closed after the run.
    """
    attached, ended = threading.Event(), threading.Event()

    def attend() -> None:
        while True:
            try:
                bus = can.Bus(interface="hilbus", channel=given.channel)
                break
            except can.CanInitializationError:
                if ended.wait(0.01):
                    return
        attached.set()
        with bus:
            program(bus, ended)

    attendant = threading.Thread(target=attend)

    def progress(_: float) -> None:
        assert attached.wait(SAFETY_NET_S)

    attendant.start()
    try:
        return run_lockstep(replace(given, progress=progress))
    finally:
        ended.set()
        attendant.join()


def test_a_listener_changes_nothing_and_sees_the_frames_with_their_bus_time(tmp_path, hashes):
    heard: list[can.Message] = []

    def listen(bus: can.BusABC, ended: threading.Event) -> None:
        while True:
            try:
                message = bus.recv(0.2)
            except can.CanOperationError:
                return
            if message is not None:
                heard.append(message)
            elif ended.is_set():
                return

    recording = with_program(options(tmp_path, channel="watched"), listen)
    assert sha256(recording) == hashes(SINE)
    assert (recording.notes["injections"], recording.notes["listener_drops"]) == ([], 0)
    assert len(heard) > 1000
    # it came while the run was under way: from its first frame on, it has all of them
    last = recording.traffic[-len(heard) :]
    assert [round(message.timestamp * 1e9) for message in heard] == last[:, 0].tolist()
    assert [message.arbitration_id for message in heard] == (last[:, 1] & 0x1FFF_FFFF).tolist()


def test_a_listener_that_never_reads_does_not_stall_the_run(tmp_path, hashes):
    recording = with_program(options(tmp_path, channel="ignored"), lambda bus, ended: ended.wait())
    assert sha256(recording) == hashes(SINE)


def test_a_listener_that_leaves_in_the_middle_changes_nothing(tmp_path, hashes):
    recording = with_program(options(tmp_path, channel="left"), lambda bus, ended: bus.recv(SAFETY_NET_S))
    assert sha256(recording) == hashes(SINE)


def test_an_injected_frame_is_on_record_and_makes_another_run(tmp_path, hashes):
    frame = CONTRACT.bench_load.frame(CONTRACT.bench_load.pack(-1000))

    def inject(bus: can.BusABC, ended: threading.Event) -> None:
        bus.recv(SAFETY_NET_S)  # the run is under way, and the supervisor has had its say
        bus.send(
            can.Message(arbitration_id=frame.can_id & 0x1FFF_FFFF, data=frame.data.to_bytes(4, "little"))
        )
        ended.wait()

    recording = with_program(options(tmp_path, channel="injected"), inject)
    assert len(recording.notes["injections"]) == 1
    assert sha256(recording) != hashes(SINE)
    assert [CONTRACT.bench_load.frame(data) for data in payloads(recording)].count(frame) == 1
    assert -1000.0 in recording.plant["load_n"]


def payloads(recording: Recording) -> list[int]:
    traffic = recording.traffic
    return traffic[traffic[:, 1] == CONTRACT.bench_load.can_id][:, 3].tolist()


# the hub of a run


def test_a_channel_in_use_is_refused_before_anything_starts(tmp_path, hub):
    with pytest.raises(LinkError, match="has a hub already"):
        run_lockstep(options(tmp_path, channel="test"))


def test_a_run_leaves_no_socket(tmp_path):
    run_lockstep(options(tmp_path, replace(SINE, duration_s=0.01), channel="mine"))
    assert list(link.socket_directory().iterdir()) == []


def test_a_run_that_is_stopped_before_its_first_period_still_has_a_result(tmp_path):
    given = options(tmp_path)
    given.stopped.set()
    recording = run_inprocess(given)
    assert recording.ending == INTERRUPTED
    assert recording.simulated_s > 0
