"""The kernel on the nominal machine: tracking figures, integers against floats, both machines alike."""

import numpy as np
import pytest
from adrc_in_floats import FloatAdrc
from kernel_runs import CASES, CheckedController, make_case, step_through

from firmware_py.kernel import layout as k
from firmware_py.tuning import ADRC, PI_STAR, LimiterTuning, Tuning
from hil.closed_loop import PERIOD_S, run_closed_loop
from hil.scenario import builtin_names, load_scenario
from plant_sim.parameters import PlantParameters

NOMINAL = Tuning().calibration()

# rms mm, max mm of the controllers this project was designed with, on the same timing chart
DESIGN_FIGURES = {
    "p": {
        "sine": (3.060, 5.007),
        "sine_load": (3.525, 5.272),
        "lift_lower": (2.422, 3.877),
        "lift_lower_load": (2.990, 5.814),
    },
    "pi": {
        "sine": (1.262, 2.080),
        "sine_load": (1.407, 2.251),
        "lift_lower": (2.046, 5.586),
        "lift_lower_load": (2.446, 7.030),
    },
    "pi_star": {
        "sine": (0.116, 0.267),
        "sine_load": (0.166, 1.318),
        "lift_lower": (0.643, 3.227),
        "lift_lower_load": (0.669, 3.466),
    },
    "adrc": {
        "sine": (0.057, 0.124),
        "sine_load": (0.105, 1.166),
        "lift_lower": (0.218, 1.098),
        "lift_lower_load": (0.325, 1.634),
    },
}
TUNINGS = {
    "p": Tuning(law=k.LAW_P),
    "pi": Tuning(law=k.LAW_PI),
    "pi_star": Tuning(law=k.LAW_PI, pi=PI_STAR),
    "adrc": Tuning(law=k.LAW_ADRC),
}


def gate(scenario):
    """RMS and maximum that ADRC must keep, mm."""
    limits = load_scenario(scenario).limits["adrc"]
    return limits["rms_mm"], limits["max_mm"]


@pytest.mark.parametrize("scenario", builtin_names())
def test_adrc_meets_its_gate(scenario):
    case = make_case(scenario)
    run = run_closed_loop(NOMINAL, case.setpoint, case.load_n)
    rms_mm, max_mm = gate(scenario)
    assert run.rms_mm < rms_mm
    assert run.max_mm < max_mm
    assert run.saturations == 0


@pytest.mark.parametrize(("factor", "figures"), [(1 / 2, (0.247, 0.957)), (1 / 3, (0.80, 2.80))])
def test_adrc_misses_its_gate_when_the_oil_is_softer(factor, figures):
    """The known weakness of this tuning."""
    case = CASES["sine"]
    softer = PlantParameters().scaled(bulk_modulus=factor)
    run = run_closed_loop(NOMINAL, case.setpoint, case.load_n, parameters=softer)
    assert (run.rms_mm, run.max_mm) == pytest.approx(figures, rel=0.05)
    rms_mm, max_mm = gate("sine")
    assert run.rms_mm > rms_mm
    assert run.max_mm > max_mm


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("controller", TUNINGS)
def test_every_law_tracks_as_it_was_designed_to(controller, case):
    run = run_closed_loop(TUNINGS[controller].calibration(), CASES[case].setpoint, CASES[case].load_n)
    assert (run.rms_mm, run.max_mm) == pytest.approx(DESIGN_FIGURES[controller][case], rel=0.05)


@pytest.mark.parametrize("case", CASES)
def test_only_the_first_ticks_are_limited(case):
    """The rod starts micrometres inside the stop, the references at 0; then they pass untouched."""
    run = run_closed_loop(NOMINAL, CASES[case].setpoint, CASES[case].load_n)
    limited = np.flatnonzero(run.flags & k.FLAG_SETPOINT_LIMITED)
    assert limited.size == 0 or limited[-1] < 10


@pytest.mark.parametrize("case", CASES)
def test_int32_stays_within_micrometres_of_floats(case):
    run = run_closed_loop(NOMINAL, CASES[case].setpoint, CASES[case].load_n)
    floats = step_through(CASES[case], lambda position_um: FloatAdrc(ADRC, position_um).step)
    difference_um = (run.position_m - floats) * 1e6
    assert np.abs(difference_um).max() <= 2.0
    assert np.sqrt(np.mean(difference_um**2)) <= 0.5


@pytest.mark.parametrize("case", CASES)
def test_the_interpreted_kernel_never_overflows_and_drives_the_same_positions(case, kernel_modules):
    """Also pins the timing chart: both loops hold the command of x(t_k) over [t_k+1, t_k+2)."""
    run = run_closed_loop(NOMINAL, CASES[case].setpoint, CASES[case].load_n)
    positions = step_through(
        CASES[case],
        lambda position_um: CheckedController(kernel_modules, NOMINAL, k.LAW_ADRC, position_um).step,
    )
    assert np.array_equal(positions, run.position_m)


def test_states_use_the_bits_they_were_scaled_for():
    peaks = np.zeros(k.ST_SIZE, np.int64)
    for case in CASES.values():
        run = run_closed_loop(NOMINAL, case.setpoint, case.load_n)
        peaks = np.maximum(peaks, np.abs(run.states.astype(np.int64)).max(axis=0))
    bits = {index: int(peaks[index]).bit_length() for index in range(k.ST_V1, k.ST_Z4 + 1)}
    assert bits[k.ST_V1] == bits[k.ST_Z1] == 30
    assert bits[k.ST_V2] == 25
    assert bits[k.ST_V3] == 20
    assert all(24 <= bits[index] <= 26 for index in (k.ST_Z2, k.ST_Z3, k.ST_Z4))


@pytest.mark.parametrize("from_mm", [50, 100, 200])
def test_the_limiter_tames_a_setpoint_step_of_50_mm(from_mm):
    setpoint = np.full(3000, from_mm * 10_000, np.int32)
    setpoint[1500:] += 500_000
    unlimited = Tuning(limiter=LimiterTuning(7.5, 7500.0)).calibration()
    overshoot_mm = {}
    for name, calibration in (("limited", NOMINAL), ("raw", unlimited)):
        run = run_closed_loop(calibration, setpoint, np.zeros(3000), hold_periods=2500)
        overshoot_mm[name] = -run.error_m[1500:].min() * 1e3
        assert np.abs(run.error_m[2500:]).max() < 1e-5
    assert overshoot_mm["limited"] < 2.5
    assert overshoot_mm["raw"] > 3 * overshoot_mm["limited"]


def test_more_delay_tracks_worse_and_still_meets_the_gate():
    case = CASES["sine"]
    one, two = (run_closed_loop(NOMINAL, case.setpoint, case.load_n, delay_periods=n) for n in (1, 2))
    assert one.rms_mm < two.rms_mm < gate("sine")[0]


def test_hold_periods_come_before_the_first_row():
    setpoint = np.full(50, 100_000, np.int32)
    held = run_closed_loop(NOMINAL, setpoint, np.zeros(50), hold_periods=1000)
    assert held.position_m.size == 50
    assert np.abs(held.error_m).max() < 1e-4


def test_a_coarser_position_sensor_makes_the_command_chatter():
    case = CASES["sine"]
    fine, coarse = (run_closed_loop(NOMINAL, case.setpoint, case.load_n, position_lsb_um=n) for n in (1, 10))
    assert coarse.chatter_rpm_per_period > 5 * fine.chatter_rpm_per_period


def test_options_out_of_range_are_refused():
    setpoint = np.zeros(10, np.int32)
    with pytest.raises(ValueError, match="closed loop"):
        run_closed_loop(NOMINAL, setpoint, np.zeros(11))
    with pytest.raises(ValueError, match="closed loop"):
        run_closed_loop(NOMINAL, setpoint, np.zeros(10), delay_periods=0)


def test_the_error_is_the_references_minus_the_unquantised_position():
    setpoint = np.arange(100, dtype=np.int32)
    run = run_closed_loop(NOMINAL, setpoint, np.zeros(100))
    assert run.reference_m == pytest.approx(setpoint * 1e-7)
    assert run.error_m == pytest.approx(run.reference_m - run.position_m)
    assert run.position_m[0] != 0.0
    assert abs(run.position_m[0]) < 5e-6
    assert run.rms_mm == pytest.approx(np.sqrt(np.mean((run.error_m * 1e3) ** 2)))
    assert run.reference_m.size * PERIOD_S == pytest.approx(0.1)
