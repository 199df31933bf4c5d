"""The linear loop against the plant's integrator, the kernel, scipy's frequency response and runs in time."""

import math

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.tuning import LINEAR, PI_STAR, CommandFilterTuning, FrontEndTuning, PiTuning, Tuning
from firmware_py.tuning import TUNINGS as BUILT_IN
from hil.closed_loop import run_closed_loop
from hil.study.linear import (
    OPERATING_POINTS,
    StateSpace,
    analyse,
    closed_loop,
    controller_model,
    linear_loop,
    plant_model,
)
from hil.study.stability import describe
from plant_sim import PlantParameters, advance
from plant_sim import layout as at
from plant_sim.derived import steady_motion
from plant_sim.machine import Machine

P = PlantParameters()
RAD_S_PER_COUNT = math.pi / 120
PI_STAR_TUNING = Tuning(law=k.LAW_PI, pi=PI_STAR)
TUNINGS = {
    "p": Tuning(law=k.LAW_P),
    "pi": Tuning(law=k.LAW_PI),
    "pi_star": PI_STAR_TUNING,
    "adrc": Tuning(law=k.LAW_ADRC),
    "linear": Tuning(adrc=LINEAR),
}
FILTER = CommandFilterTuning(time_constant_s=3.8e-3, slew_rad_s2=4000.0)
NO_FILTER = CommandFilterTuning(time_constant_s=0.0, slew_rad_s2=4000.0)
BOTH_WAYS_ALIKE = FrontEndTuning(extend_rad_per_m=1475.0, retract_rad_per_m=1475.0)
FILTERED = {
    "pi_ff": Tuning(law=k.LAW_PI_FF, pi=PI_STAR, command_filter=FILTER),
    "scheduled": Tuning(law=k.LAW_SCHEDULED, front_end=BOTH_WAYS_ALIKE, command_filter=FILTER),
    "scheduled_unfiltered": Tuning(law=k.LAW_SCHEDULED, front_end=BOTH_WAYS_ALIKE, command_filter=NO_FILTER),
}
STROKE_OF_THE_DESIGN_M = (3e-4, 0.02, 0.1, 0.2, 0.3, 0.37)
"""The first designs were judged up to 0.37 m."""


def largest_ms(tuning, point="shut"):
    return max(float(analyse(tuning, x, point=point).ms) for x in STROKE_OF_THE_DESIGN_M)


def test_ms_of_the_designs_is_that_of_the_papers_model_with_both_chambers_shut():
    assert largest_ms(TUNINGS["adrc"]) == pytest.approx(1.82, abs=0.01)
    assert largest_ms(TUNINGS["pi_star"]) == pytest.approx(2.00, abs=0.01)


@pytest.mark.parametrize("point", OPERATING_POINTS)
@pytest.mark.parametrize("position_m", [3e-4, 0.2, 0.395])
def test_the_plant_is_sampled_as_the_matrix_exponential_says(position_m, point):
    a, b = OPERATING_POINTS[point](P, position_m)
    rate = 1.0 / P.motor_time_constant_s
    continuous = np.zeros((6, 6))  # x, v, p_A, p_B, ω, command
    continuous[:4, :5] = np.column_stack([a, b])
    continuous[4, 4:] = -rate, rate
    expected = expm(continuous * 1e-3)[:5]
    model = plant_model(Machine(), position_m, point)
    row_scale = np.abs(expected).max(axis=1, keepdims=True)
    sampled = np.column_stack([model.a[:5, :5], model.a[:5, 5]])
    assert sampled / row_scale == pytest.approx(expected / row_scale, abs=1e-6)


def held_run(controller, position_m, periods, delay_periods=1):
    """Positions (m) off the held rest after a push of 1 nm: the integrator under the controller's model."""
    motion = steady_motion(P, position_m)
    state, p = motion.state.copy(), P.vector()
    rest = state[at.MOTOR_SPEED]
    state[at.POSITION] += 1e-9
    memory = np.zeros(controller.b.size)
    pending = [0.0] * delay_periods
    positions = np.empty(periods)
    for tick in range(periods):
        positions[tick] = state[at.POSITION] - position_m
        pending.append(controller.c @ memory + controller.d * positions[tick])
        memory = controller.a @ memory + controller.b * positions[tick]
        advance(state, p, rest + pending.pop(0), 0.0, 1e-3, 10)
    return positions


@pytest.mark.parametrize("delay_periods", [1, 2, 3])
@pytest.mark.parametrize("position_m", [3e-3, 0.15, 0.39])
@pytest.mark.parametrize("law", ["pi_star", "adrc"])
def test_a_push_of_a_nanometre_goes_as_the_linear_loop_says(law, position_m, delay_periods):
    controller = controller_model(TUNINGS[law], position_m)
    matrix = closed_loop(plant_model(Machine(delay_periods=delay_periods), position_m), controller)
    state = np.zeros(matrix.shape[0])
    state[0] = 1e-9
    expected = np.empty(300)
    for tick in range(300):
        expected[tick] = state[0]
        state = matrix @ state
    positions = held_run(controller, position_m, 300, delay_periods)
    assert positions == pytest.approx(expected, abs=0.01 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("law", "position_m", "stable"),
    [("adrc", 0.2, True), ("adrc", 0.395, False), ("p", 0.38, False), ("pi_star", 0.395, True)],
)
def test_a_small_push_grows_or_decays_at_the_dominant_eigenvalues_rate(law, position_m, stable):
    loop = analyse(TUNINGS[law], position_m)
    assert loop.stable == stable
    positions = np.abs(held_run(controller_model(TUNINGS[law], position_m), position_m, 6000))
    first, second = (positions[start : start + 1000].max() for start in (2000, 4500))
    if second > 1e-13:  # else it has died down to the integrator's rounding
        assert (second / first) ** (1 / 2500) == pytest.approx(float(loop.spectral_radius), abs=2e-4)
    assert (second < first) == stable


def peak_to_peak_at_rest_um(tuning, machine, position_m):
    setpoint = np.full(2000, round(position_m * 1e7), np.int32)
    run = run_closed_loop(
        tuning.calibration(),
        setpoint,
        np.zeros(setpoint.size),
        parameters=machine.parameters,
        hold_periods=9000,
    )
    return np.ptp(run.position_m) * 1e6


@pytest.mark.parametrize("position_m", [0.2, 0.3, 0.395])
@pytest.mark.parametrize(
    "machine",
    [
        Machine(),
        Machine(bulk_modulus=0.3, mass=1.5, leak=0.5, efficiency=0.95, motor_time_constant_s=0.002),
        Machine(bulk_modulus=0.3, mass=0.5, leak=0.5, efficiency=0.7),
    ],
    ids=describe,
)
@pytest.mark.parametrize("law", ["pi_star", "adrc", "linear", "robust"])
def test_the_kernel_holds_the_rod_still_just_where_the_held_loop_is_stable(law, machine, position_m):
    """With both chambers shut, the paper's model, many of these loops look stable that cycle."""
    tuning = (TUNINGS | BUILT_IN)[law]
    peak_to_peak_um = peak_to_peak_at_rest_um(tuning, machine, position_m)
    stable = bool(analyse(tuning, position_m, machine=machine).stable)
    assert (peak_to_peak_um < 5.0) == stable
    assert (peak_to_peak_um < 25.0) == stable


def test_the_papers_tuning_cycles_near_the_strokes_end_unseen_by_the_papers_model():
    assert peak_to_peak_at_rest_um(Tuning(), Machine(), 0.395) > 100.0
    assert analyse(Tuning(), 0.395, point="shut").stable


def largest_difference(tuning, rest_um, amplitude_um):
    """Largest difference in rad/s of the kernel's commands from the model's, the position swinging."""
    calibration, state = tuning.calibration().array(), np.zeros(k.ST_SIZE, np.int32)
    io = np.zeros(k.IO_SIZE, np.int32)
    time_s = np.arange(400) * 1e-3
    swing = np.sin(2 * np.pi * 7.0 * time_s) + 0.5 * np.sin(2 * np.pi * 31.0 * time_s)
    position_um = rest_um + np.rint(amplitude_um * swing).astype(int)
    io[[k.IO_LAW, k.IO_SETPOINT, k.IO_POSITION]] = tuning.law, rest_um * 10, rest_um
    control_reset(calibration, state, io)
    model = controller_model(tuning, rest_um * 1e-6)
    memory = np.zeros(model.b.size)
    commands = np.empty((2, time_s.size))
    for tick, measured_um in enumerate(position_um):
        io[k.IO_POSITION] = measured_um
        control_step(calibration, state, io)
        offset_m = (measured_um - rest_um) * 1e-6
        commands[0, tick] = io[k.IO_TARGET_VELOCITY] * RAD_S_PER_COUNT
        commands[1, tick] = model.c @ memory + model.d * offset_m
        memory = model.a @ memory + model.b * offset_m
    assert np.abs(commands[1]).max() > 15 * RAD_S_PER_COUNT
    return np.abs(commands[0] - commands[1]).max()


@pytest.mark.parametrize("rest_um", [20_000, 200_000, 390_000])
@pytest.mark.parametrize("law", TUNINGS | FILTERED)
def test_the_kernels_small_signal_response_is_the_models(law, rest_um):
    amplitude_um = 100.0 if law in FILTERED else 20.0  # the latter within the linear zone of fal
    assert largest_difference((TUNINGS | FILTERED)[law], rest_um, amplitude_um) < 2 * RAD_S_PER_COUNT


def test_linear_adrc_is_linear_far_beyond_the_papers_linear_zones():
    assert largest_difference(Tuning(adrc=LINEAR), 200_000, 300.0) < 4 * RAD_S_PER_COUNT
    assert largest_difference(Tuning(), 200_000, 300.0) > 100 * RAD_S_PER_COUNT


@pytest.mark.parametrize("point", OPERATING_POINTS)
@pytest.mark.parametrize("law", TUNINGS)
def test_ms_is_the_peak_of_scipys_frequency_response(law, point):
    plant, controller = (
        plant_model(Machine(delay_periods=2), 0.15, point),
        controller_model(TUNINGS[law], 0.15),
    )
    omega = np.geomspace(1e-4, np.pi, 20_000)
    product = 1.0
    for model in (plant, controller):
        numerator, denominator = signal.ss2tf(
            model.a, model.b[:, None], model.c[None], np.atleast_2d(model.d)
        )
        product = product * signal.freqz(numerator[0], denominator, omega)[1]
    assert float(linear_loop(plant, controller).ms) == pytest.approx(
        np.max(1.0 / np.abs(1.0 - product)), rel=1e-3
    )


def test_loops_side_by_side_are_the_loops_one_by_one():
    positions = (0.01, 0.2, 0.395)
    plants = StateSpace.stacked([plant_model(Machine(), x) for x in positions])
    together = linear_loop(plants, controller_model(PI_STAR_TUNING, 0.0))
    alone = [analyse(PI_STAR_TUNING, x) for x in positions]
    assert together.spectral_radius == pytest.approx([float(loop.spectral_radius) for loop in alone])
    assert together.ms == pytest.approx([float(loop.ms) for loop in alone], rel=1e-6)


def test_an_unstable_loop_has_no_finite_ms():
    loop = analyse(Tuning(law=k.LAW_P, p=PiTuning(300_000.0)), 0.2)
    assert not loop.stable
    assert loop.ms == np.inf


def test_an_unknown_operating_point_is_refused():
    with pytest.raises(ValueError, match="point is 'open', must be one of shut, held, lowering"):
        analyse(Tuning(), 0.2, point="open")


def test_a_plant_whose_eigenvectors_span_nothing_is_sampled_all_the_same():
    """Without leakage the two chambers' pressures drift alike: one eigenvector too few."""
    tight, nearly = (
        analyse(BUILT_IN["robust"], 0.2, machine=Machine(leak=leak), point="shut") for leak in (0.0, 1e-6)
    )
    assert tight.spectral_radius == pytest.approx(nearly.spectral_radius, abs=1e-4)
