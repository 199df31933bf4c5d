"""What happens when a part of the bench is lost, or the bench is asked to stop."""

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
from bench_runs import (
    SAFETY_NET_S,
    alive,
    background,
    children,
    name_of,
    short_scenario,
    wait_until,
)

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.node import next_period
from firmware_py.node import EXECUTION_NS, PHASE_NS, Controller
from firmware_py.tuning import Tuning
from hil.bus import link
from hil.bus.hub import Hub, NodeGoneError
from hil.bus.wire import Clock, Wire
from hil.bus.wire_core import NO_LINK
from hil.run.inprocess import make_wire
from hil.run.lockstep import AFTERMATH_NS, LockstepSession
from hil.run.options import RigOptions
from hil.scenario import Scenario
from hil.supervisor import BRING_UP_PERIODS, Supervisor
from plant_sim.drive import State
from plant_sim.node import Plant
from plant_sim.parameters import PlantParameters

CONTRACT = Contract.load()
PERIOD_NS = 1_000_000
LONGEST_COMMAND_NS = (55 + 10 * CONTRACT.drive_command.dlc - 3) * 1000
WAIT_FOR_LATCH_NS = PERIOD_NS - PHASE_NS - EXECUTION_NS
LIMIT_RAD_S2 = PlantParameters().motor_acceleration_rad_s2


# in virtual time


def supervisor_of(scenario: Scenario) -> Supervisor:
    supervisor = Supervisor(CONTRACT, "adrc", scenario.initial_m)
    supervisor.plan_scenario(scenario)
    return supervisor


@pytest.mark.parametrize("lost_ms", [1600.0, 2500.1, 2500.55, 2500.65, 2500.75, 4000.9])
def test_without_its_controller_the_motor_stops_in_time(lost_ms):
    """One frame that is under way, three periods from when it is latched, then the ramp.

    The motor follows the ramp with its lag of 5 ms.
    """
    supervisor = supervisor_of(short_scenario(5.0))
    plant = Plant(CONTRACT, PlantParameters())
    controller = Controller(CONTRACT, Tuning().calibration().to_bytes())
    wire = make_wire(CONTRACT, 1_000_000)
    ports = [wire.attach(supervisor), wire.attach(plant), wire.attach(controller, Clock(PHASE_NS))]
    for port in ports:
        wire.start(port)
    lost_ns = round(lost_ms * 1e6)
    wire.run(lost_ns)
    wire.detach(ports[2])
    wire.run(lost_ns + 200 * PERIOD_NS)

    record = plant.record.columns_by_name()
    traffic = wire.traffic
    last_command_ns = int(traffic[traffic[:, 1] == CONTRACT.drive_command.can_id][-1, 0])
    assert last_command_ns <= lost_ns + LONGEST_COMMAND_NS
    latched_ns = next_period(last_command_ns)
    speed_rad_s = abs(record["speed_command_rad_s"][record["time_ns"] == latched_ns][0])
    assert speed_rad_s > 50.0
    detected_ns = record["time_ns"][np.argmax(record["drive_state"] == State.FAULT_REACTION_ACTIVE)]
    assert detected_ns == latched_ns + 3 * PERIOD_NS
    assert detected_ns < lost_ns + LONGEST_COMMAND_NS + 3 * PERIOD_NS + WAIT_FOR_LATCH_NS
    stopped_ns = record["time_ns"][np.flatnonzero(record["speed_command_rad_s"])[-1]] + PERIOD_NS
    ramp_ns = math.ceil(speed_rad_s / LIMIT_RAD_S2 * 1000) * PERIOD_NS
    assert stopped_ns <= detected_ns + ramp_ns
    after_lag = record["time_ns"] > stopped_ns + 40 * PERIOD_NS
    assert np.abs(record["motor_speed_rad_s"][after_lag]).max() < 0.1
    assert record["drive_state"][-1] == State.FAULT


def test_without_its_plant_the_controller_is_in_the_safe_state_within_three_periods():
    supervisor = supervisor_of(short_scenario(1.0))
    controller = Controller(CONTRACT, Tuning().calibration().to_bytes())
    wire = make_wire(CONTRACT, 1_000_000)
    plant_port = wire.attach(Plant(CONTRACT, PlantParameters()))
    for port in (wire.attach(supervisor), plant_port, wire.attach(controller, Clock(PHASE_NS))):
        wire.start(port)
    lost_ns = 500 * PERIOD_NS + PHASE_NS + 1
    wire.run(lost_ns)
    wire.detach(plant_port)
    wire.run(lost_ns + 10 * PERIOD_NS)
    record = controller.record.columns_by_name()
    safe = record["time_ns"] + PHASE_NS >= lost_ns + 3 * PERIOD_NS - 1
    assert (record["state"][safe] == 3).all()
    assert (record["target_velocity_0p25rpm"][safe] == 0).all()


def test_after_a_loss_the_others_play_on_for_a_tenth_of_a_second_of_bus_time():
    """A fixed amount of work, whatever the machine: what makes the end come soon."""
    assert AFTERMATH_NS == 100 * PERIOD_NS

    lost_rig = SimpleNamespace(
        contract=CONTRACT,
        options=RigOptions(record_directory=Path()),
        give_up=lambda: None,
        hub=SimpleNamespace(
            nodes={"plant": Dying("plant"), "controller": Dying("controller")}, service=lambda: None
        ),
        processes=SimpleNamespace(exit_code=lambda name: " (exit code 9)"),
        records=lambda: {"plant": None, "controller": None},
    )
    session = LockstepSession(lost_rig, Wire(1_000_000), supervisor_of(short_scenario(1.0)), 0.0)
    assert session.ending == "the plant process ended at bus time 0.000 s (exit code 9)"
    assert session.wire.now_ns == AFTERMATH_NS
    assert len(session.wire.traffic) >= 100


class Dying:
    """A node that is lost at power-on."""

    link, accepts, latched = NO_LINK, None, frozenset()

    def __init__(self, name: str) -> None:
        self.name = name

    def ask(self, packet, answer):
        raise NodeGoneError(self.name, "ended")

    late_answer = ask


def test_a_hub_that_vanishes_ends_a_node_at_once_with_one_line():
    """No timer is involved: the node's socket reports the end."""
    hub = Hub(Wire(1_000_000), "test", expected=frozenset({"plant", "controller"}))
    with background("plant_sim", "-i", "hilbus", "-c", "test") as plant:
        wait_until(lambda: hub.service(0.01) or hub.nodes, "the plant says hello")
        for node in hub.nodes.values():
            node._link.close()  # as when the hub's process is killed: no stop is sent
        hub.nodes.clear()
        hub.close()
        _, said = plant.communicate(timeout=SAFETY_NET_S)
    assert plant.returncode == 3
    assert re.fullmatch(r"python -m plant_sim: the hub of channel 'test' ended.*\n", said)


def test_a_node_without_a_hub_says_how_to_start_one():
    with background("firmware_py", "-i", "hilbus", "-c", "test") as firmware:
        _, said = firmware.communicate(timeout=SAFETY_NET_S)
    assert firmware.returncode == 2
    assert "hil bus --channel test" in said
    assert said.count("\n") == 1


# real processes


class Bench:
    """A lock-step run in a process of its own that has its sides up and running."""

    def __init__(self, process: subprocess.Popen[str], out: Path) -> None:
        self.process = process
        self.out = out
        self.sides = {name_of(pid).removeprefix("hil-"): pid for pid in children(process.pid)}

    def end(self) -> tuple[int, str]:
        """Wait for the bench and return exit code and standard error."""
        _, said = self.process.communicate(timeout=SAFETY_NET_S)
        return self.process.returncode, said

    def wait_until_all_is_gone(self) -> None:
        wait_until(
            lambda: not any(alive(pid) for pid in (self.process.pid, *self.sides.values())),
            "no process is left",
        )


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A run that would take minutes, in the midst of its scenario."""
    with running(tmp_path / "out") as bench:
        yield bench


@contextmanager
def running(out: Path, *arguments: str) -> Iterator[Bench]:
    scenario = out.parent / "long.toml"
    scenario.write_text('title = "long"\nreference = "sine"\nduration_s = 3600\n')
    process = subprocess.Popen(
        [sys.executable, "-m", "hil", "run", str(scenario), "--out", str(out), "-c", "watched", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    bench = None
    try:
        wait_for_the_reference(process)
        bench = Bench(process, out)
        assert bench.sides.keys() == {"plant", "controller"}
        yield bench
    finally:
        for pid in (process.pid, *(bench.sides.values() if bench else ())):
            if alive(pid):
                os.kill(pid, signal.SIGKILL)
        process.communicate()


def wait_for_the_reference(process: subprocess.Popen[str]) -> None:
    """Attach as any tool would and wait until the first period of the scenario is over."""

    def attached() -> can.BusABC | None:
        assert process.poll() is None, process.communicate()
        try:
            return can.Bus(interface="hilbus", channel="watched")
        except can.CanInitializationError:
            return None

    with wait_until(attached, "the hub is there") as bus:
        bus_s = 0.0
        while bus_s < BRING_UP_PERIODS * 1e-3 + 0.1:
            message = bus.recv(SAFETY_NET_S)
            assert message is not None
            bus_s = message.timestamp


@pytest.mark.parametrize("victim", ["plant", "controller"])
def test_losing_a_side_ends_the_run_with_one_line(bench, victim, record_property):
    begin_s = time.monotonic()
    os.kill(bench.sides[victim], signal.SIGKILL)
    code, said = bench.end()
    bench.wait_until_all_is_gone()
    record_property("seconds_to_the_end", round(time.monotonic() - begin_s, 2))
    assert code == 3
    assert re.fullmatch(
        rf"hil: the {victim} process ended at bus time \d+\.\d+ s \(exit code -9\).*\n", said
    ), said
    assert not list(link.socket_directory().iterdir())
    assert not list(bench.out.glob(".unfinished-*"))
    assert (bench.out / "bus.log").exists()
    if victim == "controller":
        at_rest_ms = re.search(r"the motor was at rest (\d+) ms later", said)
        assert at_rest_ms
        assert int(at_rest_ms[1]) < 100


def test_losing_the_bench_ends_both_sides(bench, record_property):
    # in sessions of their own, so that a Ctrl-C at the terminal reaches the bench only
    assert all(os.getsid(pid) == pid for pid in bench.sides.values())
    begin_s = time.monotonic()
    bench.process.kill()
    bench.wait_until_all_is_gone()
    record_property("seconds_to_the_end", round(time.monotonic() - begin_s, 2))
    with Hub(Wire(1_000_000), "watched", expected=None):
        pass  # the socket it could not remove is in nobody's way


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_no_process_no_socket_and_a_whole_log(bench, number):
    bench.process.send_signal(number)
    code, said = bench.end()
    bench.wait_until_all_is_gone()
    assert (code, said) == (130, "hil: interrupted\n")
    assert not list(link.socket_directory().iterdir())
    assert {file.name for file in bench.out.iterdir()} == {
        "result.json",
        "trace.csv",
        "bus.log",
        "picture.png",
    }
    assert_whole(bench.out / "bus.log")


def assert_whole(log: Path) -> None:
    """Every frame is complete, in order, and every protected message counts without a gap."""
    assert log.read_text().endswith("\n")
    with can.LogReader(log) as reader:
        messages = list(reader)
    assert len(messages) > 500
    stamps_s = [message.timestamp for message in messages]
    assert stamps_s == sorted(stamps_s)
    check = CONTRACT.position_feedback.checker().check
    statuses = {
        check(int.from_bytes(message.data, "little")).name
        for message in messages
        if Frame(message.arbitration_id, message.dlc, 0)[:2]
        == (CONTRACT.position_feedback.can_id, CONTRACT.position_feedback.dlc)
    }
    assert statuses <= {"INITIAL", "OK"}


def test_a_run_interrupted_while_its_sides_start_leaves_nothing(tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "hil", "run", "sine", "--out", str(out)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        sides = wait_until(lambda: children(process.pid), "the sides are started")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=SAFETY_NET_S)
    finally:
        process.kill()
    wait_until(lambda: not any(alive(pid) for pid in sides), "no process is left")
    assert process.returncode in (2, 130)
    assert said.count("\n") == 1
    assert "interrupted" in said
    assert not list(link.socket_directory().iterdir())
    assert not list(out.glob(".unfinished-*"))
