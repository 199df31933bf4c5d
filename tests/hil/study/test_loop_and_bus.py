"""The compiled loop without a bus gives what the bench gives over the bus, bit for bit, on any machine."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_runs import short_scenario

from dbc.contract import Contract
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.diagnosis import State
from firmware_py.node import PHASE_NS
from firmware_py.tuning import TUNINGS
from hil.closed_loop import RUNNING_BEFORE_START_PERIODS, ClosedLoopRun, play_closed_loop
from hil.measure import result_of, trace_of
from hil.run.inprocess import run_inprocess
from hil.run.options import RunOptions
from hil.scenario import CONTROLLERS, Scenario, load_scenario
from hil.study.box import load_box
from plant_sim.machine import Machine

PERIOD_NS = 1_000_000
SAMPLES = load_box().samples(10, seed=7)
WORST = Machine(
    mass=1.5,
    bulk_modulus=0.3,
    efficiency=0.7,
    motor_time_constant_s=0.02,
    motor_acceleration_rad_s2=2000.0,
    position_lsb_um=10,
    delay_periods=3,
)
"""Under it ADRC swings, as the motor cannot accelerate as it is told to."""


def sha256(commands_rpm: np.ndarray) -> str:
    return hashlib.sha256((4 * commands_rpm).astype("<i8").tobytes()).hexdigest()


def agreed(scenario: Scenario, tuning: str, controller: str) -> ClosedLoopRun:
    """Play a scenario both ways, make sure that nothing differs, and return the run."""
    options = RunOptions(scenario, controller, record_directory=Path(), tuning=chosen_tuning(tuning))
    contract = Contract.load()
    recording = run_inprocess(options)
    trace = trace_of(recording, contract)
    result = result_of(recording, trace, contract, options, "inprocess")
    law = 1 + CONTROLLERS.index(options.controller)
    run = play_closed_loop(scenario, options.tuning.calibration, law=law)
    assert sha256(run.command_rpm) == sha256(trace["target_velocity_rpm"])
    assert np.array_equal(run.position_m, trace["position_m"])
    figures = result["rms_mm"], result["max_mm"], result["chatter_rpm_per_period"]
    assert (run.rms_mm, run.max_mm, run.chatter_rpm_per_period) == figures
    return run


@pytest.mark.parametrize("number", range(len(SAMPLES)))
def test_on_a_sample_of_the_box_under_every_tuning(number):
    scenario = short_scenario(1.0, load=((0.0, 700.4), (0.4504, -2000.0)), reference="full_stroke")
    for tuning in TUNINGS:
        agreed(replace(scenario, machine=SAMPLES[number]), tuning, "")


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_under_every_law_on_a_machine_that_is_driven_to_its_limits(controller):
    """Under ADRC until the supervision of the motion, which the loop lacks, stops the machine at 5.25 s."""
    duration_s = 5.2 if controller == "adrc" else None
    run = agreed(replace(load_scenario("sine", duration_s), machine=WORST), "paper", controller)
    assert controller != "adrc" or np.ptp(run.command_rpm) > 3000.0


@pytest.mark.parametrize("delay_periods", [1, 2, 3])
@pytest.mark.parametrize("position_lsb_um", [1, 10])
def test_with_every_delay_and_resolution(delay_periods, position_lsb_um):
    machine = Machine(delay_periods=delay_periods, position_lsb_um=position_lsb_um)
    agreed(replace(short_scenario(0.5), machine=machine), "paper", "adrc")


def test_over_a_whole_scenario():
    agreed(replace(load_scenario("lift_lower_load"), machine=SAMPLES[0]), "paper", "")


@pytest.mark.parametrize("delay_periods", [1, 2, 3])
def test_the_controller_runs_for_as_long_before_the_start_as_the_loop_assumes(delay_periods):
    scenario = replace(short_scenario(0.1), machine=Machine(delay_periods=delay_periods))
    recording = run_inprocess(RunOptions(scenario, record_directory=Path()))
    controller = recording.controller
    first_ns = int(controller["time_ns"][controller["state"] == State.RUN][0])
    periods = (recording.start_ns - first_ns) // PERIOD_NS
    assert first_ns % PERIOD_NS in (0, PHASE_NS)
    assert periods == RUNNING_BEFORE_START_PERIODS
