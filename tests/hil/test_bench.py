"""The bench in a test's hand: what it refuses, and that it plays what `hil run` plays."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bench_runs import played, sha256

from hil.bench import Bench
from hil.run.inprocess import InprocessRig
from hil.run.options import BenchError, RigOptions
from hil.scenario import load_scenario


@pytest.fixture
def rig() -> Iterator[InprocessRig]:
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        yield rig


def test_step_by_step_it_plays_what_hil_run_plays(rig):
    scenario = load_scenario("sine_load")
    bench = Bench(rig, controller="adrc")
    bench.setpoint(scenario.position_m)
    bench.run(3.0)
    bench.load_force(-2000)
    bench.run(7.0)
    assert sha256(bench.recording) == sha256(played("sine_load").recording)


def test_a_run_in_many_steps_is_the_same_as_in_one(rig):
    one, many = Bench(rig), Bench(rig)
    one.run(0.3)
    for _ in range(100):
        many.run(0.003)
    assert sha256(one.recording) == sha256(many.recording)


def test_a_reference_may_be_a_number_or_a_function_of_either(rig):
    recordings = []
    for reference in (0.01, lambda time_s: 0.01, lambda time_s: np.full(len(time_s), 0.01)):
        bench = Bench(rig)
        bench.setpoint(reference)
        bench.run(0.1)
        recordings.append(sha256(bench.recording))
    assert len(set(recordings)) == 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda bench: bench.corrupt("PositionFeedback", 48), "PositionFeedback has bits 0 to 47, not 48"),
        (
            lambda bench: bench.corrupt("PositionFeedback", -1),
            "bit is -1, must be a whole number from 0",
        ),
        (lambda bench: bench.drop("PositionFeedback", 0), "count is 0, must be a whole number from 1 to"),
        (
            lambda bench: bench.delay("PositionFeedback", -0.001),
            "delay_s is -0.001, must be a number",
        ),
        (lambda bench: bench.setpoint(200), "a setpoint of 200.0 m is beyond 0.999 m"),
        (lambda bench: bench.load_force(1e9), "is beyond 1e"),
        (lambda bench: bench.run(-1), "must be one period"),
        (lambda bench: bench.run(0.0004), "must be one period"),
        (lambda bench: bench.drop("Position"), "message is 'Position', must be one of DriveCommand"),
        (lambda bench: bench.silence("Setpoint"), "there is no message 'Setpoint'"),
        (lambda bench: bench.signal("DriveStatus.Speed"), "DriveStatus has no signal 'Speed'"),
        (lambda bench: bench.power_off("drive"), "node is 'drive', must be one of controller, plant"),
    ],
)
def test_what_does_not_exist_is_refused(rig, wrong, said):
    with pytest.raises(ValueError, match=said):
        wrong(Bench(rig))


def test_an_unknown_controller_and_an_impossible_bit_rate_are_refused(rig):
    with pytest.raises(ValueError, match="there is no controller 'lqr': choose one of p, pi, adrc"):
        Bench(rig, controller="lqr")
    with pytest.raises(ValueError, match="position_m is 5, must be from 0 to"):
        Bench(rig, position_m=5)
    with pytest.raises(BenchError, match="bit rate -5 is not"):
        Bench(rig, bit_rate=-5)
    with pytest.raises(BenchError, match="bit rate 0 is not"):
        RigOptions(record_directory=Path(), bit_rate=0)
