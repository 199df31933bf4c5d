"""How closely the rod follows."""

import numpy as np
import pytest
from acceptance import play, undisturbed

from firmware_py.diagnosis import State
from hil.references import sine

virtual_time = pytest.mark.needs("virtual_time")

GATES = {  # mm RMS, mm max
    "sine": (0.10, 0.25),
    "sine_load": (0.20, 1.45),
    "lift_lower": (0.35, 1.6),
    "lift_lower_load": (0.45, 2.1),
    "full_stroke": (0.15, 0.8),
}
HARD_CORNER = {
    "mass": 1.5,
    "bulk_modulus": 0.3,
    "leak": 2.5,
    "efficiency": 0.7,
    "motor_time_constant_s": 0.02,
    "motor_acceleration_rad_s2": 2000.0,
    "position_lsb_um": 10,
    "delay_periods": 3,
}
ROBUST_GATES = {  # mm RMS, mm max
    "sine": (0.10, 0.20),
    "sine_load": (0.42, 2.8),
    "lift_lower": (0.32, 1.5),
    "lift_lower_load": (0.42, 2.1),
    "full_stroke": (0.26, 1.25),
}
README = {  # mm RMS, mm max
    ("sine", "p"): (3.060, 5.007),
    ("sine", "pi"): (1.262, 2.080),
    ("sine_load", "p"): (3.525, 5.272),
    ("sine_load", "pi"): (1.407, 2.252),
    ("lift_lower", "p"): (2.422, 3.876),
    ("lift_lower", "pi"): (2.046, 5.586),
    ("lift_lower_load", "p"): (2.990, 5.814),
    ("lift_lower_load", "pi"): (2.446, 7.030),
}


@virtual_time
@pytest.mark.parametrize("scenario", GATES)
def test_adrc_meets_its_gate(bench, scenario):
    rms_mm, max_mm = GATES[scenario]
    play(bench, scenario)
    assert bench.error_mm.rms <= rms_mm
    assert bench.error_mm.max <= max_mm


@virtual_time
@pytest.mark.parametrize("scenario", ROBUST_GATES)
def test_robust_meets_its_gate(bench_at, scenario):
    bench = bench_at(tuning="robust", controller="scheduled")
    rms_mm, max_mm = ROBUST_GATES[scenario]
    play(bench, scenario)
    assert bench.error_mm.rms <= rms_mm
    assert bench.error_mm.max <= max_mm


@virtual_time
@pytest.mark.parametrize("scenario", ROBUST_GATES)
def test_robust_keeps_within_2_mm_rms_on_a_heavy_machine_with_soft_oil_and_worn_pumps(bench_at, scenario):
    bench = bench_at(tuning="robust", controller="scheduled", machine=HARD_CORNER)
    play(bench, scenario)
    assert bench.error_mm.rms <= 2.0


@virtual_time
@pytest.mark.parametrize(("scenario", "law"), README)
def test_p_and_pi_do_as_readme_says(bench_at, scenario, law):
    bench = bench_at(controller=law)
    play(bench, scenario)
    assert (bench.error_mm.rms, bench.error_mm.max) == pytest.approx(README[scenario, law], rel=0.05)


@virtual_time
@pytest.mark.bench(bit_rate=500_000)
def test_the_sine_keeps_its_gate_at_500_kbit_s(bench):
    play(bench, "sine")
    assert bench.error_mm.rms <= 0.10
    assert bench.error_mm.max <= 0.25


def test_the_start_of_the_sine_is_followed(bench):
    bench.setpoint(sine)
    bench.run(0.5)
    assert undisturbed(bench, bench.error_mm).max < 0.25


@pytest.mark.bench(position_m=0.2)
def test_a_position_is_held(bench):
    bench.run(0.5)
    assert np.ptp(undisturbed(bench, bench.position_mm.between(0.3)).values) < 0.05


@virtual_time
@pytest.mark.parametrize("position_m", [0.0, 0.001, 0.05, 0.1, 0.2, 0.3])
def test_wherever_it_starts_it_holds_its_position(bench_at, position_m):
    bench = bench_at(position_m=position_m)
    bench.run(0.3)
    assert bench.error_mm.max < 0.2
    assert bench.error_mm.between(0.2).max < 0.05


@pytest.mark.bench(position_m=0.2)
def test_a_helping_load_step_is_rejected(bench):
    bench.run(0.1)
    bench.load_force(-2000)
    bench.run(0.4)
    assert undisturbed(bench, bench.error_mm).max < 0.8
    assert undisturbed(bench, bench.error_mm.between(0.4)).max < 0.05


@virtual_time
@pytest.mark.bench(position_m=0.2)
def test_a_resisting_load_step_is_rejected(bench):
    bench.run(0.1)
    bench.load_force(2000)
    bench.run(0.4)
    assert bench.error_mm.max < 0.8
    assert bench.error_mm.between(0.4).max < 0.05


@virtual_time
@pytest.mark.bench(position_m=0.1)
def test_a_small_step_settles(bench):
    bench.setpoint(0.11)
    bench.run(0.8)
    assert bench.position_mm.values.max() < 110.0 + 4.0
    assert bench.error_mm.between(0.5).max < 0.05
    assert bench.controller_state == State.RUN
