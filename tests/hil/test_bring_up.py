"""Bringing the machine up, again and again, whatever gets lost on the way."""

from pathlib import Path

import numpy as np
import pytest

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand
from dbc.node import PERIOD_NS
from firmware_py.diagnosis import State
from firmware_py.node import PHASE_NS, Controller
from firmware_py.tuning import Tuning
from hil.bus.wire import Clock, FrameFault, Wire
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions
from hil.supervisor import BRING_UP_PERIODS, Supervisor
from plant_sim.node import Plant
from plant_sim.parameters import PlantParameters

CONTRACT = Contract.load()
COMMAND, BENCH_CONTROL = CONTRACT.controller_command, CONTRACT.bench_control
POSITION_M = 0.1


def sent(supervisor: Supervisor, periods: list[int]) -> list[tuple[int, Frame]]:
    """Call a supervisor's timer in the given periods; return what it sends, each with its period."""
    supervisor.on_start(0)
    return [(p, frame) for p in periods for _, frame in supervisor.on_timer(p * PERIOD_NS).sends]


def enables(frames: list[tuple[int, Frame]]) -> list[int]:
    return [COMMAND.unpack(frame.data).enable for _, frame in frames if frame.can_id == COMMAND.can_id]


@pytest.mark.parametrize("first", [0, 1, 7, 30])
def test_the_reset_is_sent_with_the_first_period_however_late_that_is(first):
    frames = sent(Supervisor(CONTRACT, "adrc", POSITION_M), [first, first + 1, first + 2])
    (reset,) = [(p, frame) for p, frame in frames if frame.can_id == BENCH_CONTROL.can_id]
    assert reset[0] == first
    assert BENCH_CONTROL.unpack(reset[1].data)[::2] == (BenchCommand.RESET, round(POSITION_M * 1e7))


@pytest.mark.parametrize("stall", range(1, 31))
@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_supervisor_that_stalls_still_commands_twice_without_enable_and_then_with_it(stall, length):
    periods = [p for p in range(60) if not stall <= p < stall + length]
    commanded = enables(sent(Supervisor(CONTRACT, "adrc"), periods))
    assert commanded == sorted(commanded)
    assert commanded.count(0) >= 2
    assert commanded.count(1) >= 2


def test_a_mode_command_that_is_due_every_100_ms_is_sent_a_period_late_if_need_be():
    frames = sent(Supervisor(CONTRACT, "adrc"), [p for p in range(350) if p not in (100, 200, 201)])
    assert [p for p, frame in frames if frame.can_id == COMMAND.can_id and p >= 100] == [101, 202, 300]


@pytest.mark.parametrize("lost", range(6))
@pytest.mark.parametrize("count", [1, 2])
def test_whatever_mode_commands_of_the_bring_up_are_lost_the_controller_runs(tmp_path: Path, lost, count):
    with InprocessRig(RigOptions(record_directory=tmp_path)) as rig:
        session = rig.begin("adrc", POSITION_M)
        period = 0
        while len(enables(logged(session.wire))) < lost:
            period += 1
            session.run_to(period)
        session.wire.spoil(COMMAND.can_id, FrameFault.DROP, 0, count)
        session.run_to(BRING_UP_PERIODS)
        assert session.recording().controller["state"][-1] == State.RUN


def logged(wire: Wire) -> list[tuple[int, Frame]]:
    return [(0, Frame(*map(int, row[1:]))) for row in wire.traffic]


def test_one_session_after_another_runs_on_the_same_nodes():
    """No node is powered on anew: a new supervisor resets both, the second time out of full motion."""
    plant = Plant(CONTRACT, PlantParameters())
    controller = Controller(CONTRACT, Tuning().calibration().to_bytes())
    wire = Wire(1_000_000)
    for port in (wire.attach(plant), wire.attach(controller, Clock(PHASE_NS))):
        wire.start(port)
    for session in range(3):
        supervisor = Supervisor(CONTRACT, "adrc", POSITION_M)
        supervisor.plan(BRING_UP_PERIODS, reference=lambda time_s: POSITION_M + 0.05 * time_s)
        port = wire.attach(supervisor)
        wire.start(port)
        wire.run(supervisor.start_ns + 200 * PERIOD_NS)
        wire.detach(port)
        begin, end = (
            np.searchsorted(plant.record.columns_by_name()["time_ns"], ns)
            for ns in (supervisor.start_ns, supervisor.start_ns + 200 * PERIOD_NS)
        )
        position_m = plant.record.columns_by_name()["position_m"][begin:end]
        reference_m = supervisor.record.columns_by_name()["reference_m"][-len(position_m) :]
        assert controller.record.columns_by_name()["state"][-1] == State.RUN, session
        assert abs(position_m[0] - POSITION_M) < 1e-4
        assert np.abs(reference_m - position_m).max() < 2e-3
