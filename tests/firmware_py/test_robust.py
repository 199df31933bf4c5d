"""The built-in tuning `robust`: tracking, steps, holding still, and no failure anywhere in the box."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_runs import CASES, CheckedController, step_through
from scheduled_in_floats import FloatPiFf, FloatScheduled

from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS
from hil.closed_loop import play_closed_loop, run_closed_loop
from hil.scenario import builtin_names, load_scenario
from hil.study.box import load_box
from hil.study.linear import OPERATING_POINTS
from hil.study.runs import BOX_RUNS, box_rms_mm, failed
from hil.study.stability import stability_maps
from plant_sim.machine import Machine

ROBUST = TUNINGS["robust"]
BLOCK = ROBUST.calibration()
FLOATS = {"robust": FloatScheduled, "pi_ff": FloatPiFf}
WORST_MM = {"sine": 0.8, "lift_lower_load": 2.0}


def positions_after(setpoint_mm, position_lsb_um=1):
    """Positions (mm) in each period, after 6 s at the first setpoint."""
    setpoint = np.round(np.asarray(setpoint_mm) * 1e4).astype(np.int32)
    run = run_closed_loop(
        BLOCK, setpoint, np.zeros(setpoint.size), position_lsb_um=position_lsb_um, hold_periods=6000
    )
    return run.position_m * 1e3


# tracking


@pytest.mark.parametrize("name", builtin_names())
def test_the_scheduled_law_meets_its_limits(name):
    scenario = load_scenario(name)
    run = play_closed_loop(scenario, BLOCK)
    limits = scenario.limits["scheduled"]
    assert run.rms_mm <= limits["rms_mm"]
    assert run.max_mm <= limits["max_mm"]
    assert run.saturations == 0


@pytest.mark.parametrize(("position_lsb_um", "limit_rpm"), [(1, 1.5), (10, 3.0)])
def test_its_command_does_not_chatter(position_lsb_um, limit_rpm):
    run = play_closed_loop(load_scenario("sine"), BLOCK, machine=Machine(position_lsb_um=position_lsb_um))
    assert run.chatter_rpm_per_period <= limit_rpm


@pytest.mark.parametrize("tuning", FLOATS)
@pytest.mark.parametrize("case", ["sine", "lift_lower_load"])
def test_int32_stays_within_two_micrometres_of_floats(case, tuning):
    calibration = TUNINGS[tuning].calibration()
    run = run_closed_loop(calibration, CASES[case].setpoint, CASES[case].load_n)
    floats = step_through(CASES[case], lambda position_um: FLOATS[tuning](TUNINGS[tuning], position_um).step)
    difference_um = (run.position_m - floats) * 1e6
    assert np.abs(difference_um).max() <= 2.0
    assert np.sqrt(np.mean(difference_um**2)) <= 0.5


@pytest.mark.parametrize("tuning", FLOATS)
def test_the_interpreted_kernel_never_overflows_and_drives_the_same_positions(tuning, kernel_modules):
    case, calibration = CASES["lift_lower_load"], TUNINGS[tuning].calibration()
    run = run_closed_loop(calibration, case.setpoint, case.load_n)
    positions = step_through(
        case,
        lambda position: CheckedController(kernel_modules, calibration, calibration.law, position).step,
    )
    assert np.array_equal(positions, run.position_m)


def test_states_keep_three_bits_of_reserve():
    run = play_closed_loop(load_scenario("full_stroke"), BLOCK)
    peaks = np.abs(run.states.astype(np.int64)).max(axis=0)
    states = (k.ST_V2, k.ST_V3, k.ST_Z2, k.ST_Z3, k.ST_Z4, k.ST_MOTOR, k.ST_DISTURBANCE, k.ST_COMMAND)
    assert max(int(peaks[index]).bit_length() for index in states) <= 28


# steps and holding


@pytest.mark.parametrize(("from_mm", "step_mm"), [(50, 50), (200, 50), (345, 50), (100, -50)])
@pytest.mark.parametrize("position_lsb_um", [1, 10])
def test_a_step_of_50_mm_settles_without_a_limit_cycle(from_mm, step_mm, position_lsb_um):
    target_mm = from_mm + step_mm
    positions_mm = positions_after([from_mm] * 10 + [target_mm] * 4000, position_lsb_um)[10:]
    beyond_mm = (positions_mm - target_mm) * np.sign(step_mm)
    assert beyond_mm.max() <= 3.0
    assert np.abs(beyond_mm[1000:]).max() <= 1.0
    assert np.ptp(positions_mm[-1000:]) <= 0.012


@pytest.mark.parametrize("position_mm", [0.3, 2, 20, 100, 200, 300, 395])
def test_a_coarse_sensor_moves_the_rod_by_little_while_it_is_held(position_mm):
    positions_mm = positions_after([position_mm] * 4000, position_lsb_um=10)
    assert np.ptp(positions_mm) <= 0.012
    assert np.abs(positions_mm - position_mm).max() <= 0.015


# the box of machines


def with_speed_gain(rad_per_m):
    """The tuning with one speed per rod speed in both directions."""
    front_end = replace(ROBUST.front_end, extend_rad_per_m=rad_per_m, retract_rad_per_m=rad_per_m)
    return replace(ROBUST, front_end=front_end)


@pytest.mark.parametrize("point", OPERATING_POINTS)
def test_the_linear_loop_is_stable_on_every_corner_over_the_whole_stroke(point):
    """With the mean speed per rod speed, and with those of the directions in which the rod may move there."""
    gains = ROBUST.front_end
    tunings = {"mean": (ROBUST, None), "retracting": (with_speed_gain(gains.retract_rad_per_m), None)}
    if point != "lowering":
        tunings["extending"] = (with_speed_gain(gains.extend_rad_per_m), None)
    machines = [Machine(), *load_box().corners()]
    for stability in stability_maps(tunings, machines, point=point).values():
        summary = stability.summary()
        assert summary["unstable_machines"] == 0, summary


def assert_holds(machines):
    rms_mm = box_rms_mm(BLOCK, machines)
    assert not failed(rms_mm).any(), rms_mm.max(axis=0)
    for name, limit_mm in WORST_MM.items():
        assert rms_mm[:, BOX_RUNS.index(name)].max() <= limit_mm


def test_no_failure_on_corners_and_samples_of_the_box():
    box = load_box()
    softest = [corner for corner in box.corners() if corner.bulk_modulus < 1.0 and corner.mass > 1.0]
    assert_holds(softest[::2] + box.samples(32, seed=20201120))


@pytest.mark.long
def test_no_failure_on_any_corner_nor_on_500_samples_of_the_box():
    box = load_box()
    assert_holds(box.corners() + box.samples(500, seed=1))
