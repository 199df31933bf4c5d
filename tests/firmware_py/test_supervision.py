"""What is no stuck position."""

import numba
import numpy as np

import firmware_py.compiled  # noqa: F401  (makes the firmware callable from jitted code)
from firmware_py import supervision
from firmware_py import task_layout as at
from firmware_py.state_machine import RUN
from firmware_py.tuning import TUNINGS
from hil.closed_loop import play_closed_loop
from hil.scenario import load_scenario
from hil.study.box import load_box
from plant_sim.machine import Machine

MACHINES = [Machine(), *load_box().corners()]


@numba.njit
def longest_standstill(position_um, velocity):
    """Largest count of periods; the command of a period is there when the next one begins."""
    task = np.zeros(at.TASK_SIZE, np.int32)
    task[at.STATE] = RUN
    longest = 0
    for period in range(position_um.size):
        supervision.watch_motion(task, position_um[period])
        longest = max(longest, task[at.STILL_PERIODS])
        task[at.VELOCITY] = velocity[period]
    return longest


def test_under_the_robust_tuning_no_machine_of_the_box_is_taken_for_stuck():
    """Under the scenario that comes nearest: on the worst machine its load holds the rod for 27 periods."""
    scenario, calibration = load_scenario("lift_lower_load"), TUNINGS["robust"].calibration()
    for machine in MACHINES:
        run = play_closed_loop(scenario, calibration, machine=machine)
        position_um = np.round(run.position_m * 1e6).astype(np.int32)
        velocity = np.round(run.command_rpm * 4).astype(np.int32)
        assert longest_standstill(position_um, velocity) <= 30, machine
