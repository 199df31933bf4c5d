"""The exported C on emulated processors: the same bits as compiled from Python, whatever the inputs."""

import itertools

import numpy as np
import pytest
from emulated_kernel import EmulatedKernel
from kernel_segments import Segment, run_compiled, segments

from firmware_py.calibration_block import ZONES
from firmware_py.emulated.processors import TARGETS
from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22
from firmware_py.tuning import TUNINGS
from hil.closed_loop import play_closed_loop
from hil.references import setpoint_counts
from hil.scenario import load_scenario


@pytest.fixture(scope="module", params=TARGETS)
def kernel(request):
    return EmulatedKernel(request.param)


def assert_same_bits(kernel, played):
    for number, segment in enumerate(played):
        states, outputs = run_compiled(segment)
        np.testing.assert_array_equal(kernel.run(segment), np.hstack((states, outputs)), err_msg=f"{number}")


def test_ten_thousand_steps(kernel):
    assert_same_bits(kernel, segments(10_000, seed=20201120))


@pytest.mark.long
def test_a_million_steps(kernel):
    assert_same_bits(kernel, segments(1_000_000, seed=64))


def closed_loop(tuning, law):
    """What the law is fed over a second of the lift with its load step."""
    scenario, calibration = load_scenario("lift_lower_load"), TUNINGS[tuning].calibration()
    run = play_closed_loop(scenario, calibration, law=law)
    positions = np.floor(run.position_m * 1e6 + 0.5).astype(np.int32)
    setpoints = setpoint_counts(scenario.reference_m()).astype(np.int32)
    return Segment(calibration, law, setpoints[:1000], positions[:1000])


@pytest.mark.parametrize(
    ("tuning", "law"),
    [
        ("paper", k.LAW_P),
        ("paper", k.LAW_PI),
        ("paper", k.LAW_ADRC),
        ("pi_ff", k.LAW_PI_FF),
        ("robust", k.LAW_SCHEDULED),
    ],
)
def test_closed_loop(kernel, tuning, law):
    assert_same_bits(kernel, [closed_loop(tuning, law)])


def at_the_roots(delta):
    """Errors around the linear zone and wherever |e| delta is nearly a square or a power of four."""
    roots = [root for n in range(31) for root in (2**n - 1, 2**n, 2**n + 1)]
    errors = {root * root // delta + offset for root in roots for offset in (-1, 0, 1)}
    errors |= {delta + offset for offset in (-1, 0, 1)}
    return sorted(e for e in errors if 0 < e < 2**31 - 2)


@pytest.mark.parametrize("delta", [1, 3, 214_748, 2**31 - 1])
def test_where_square_roots_and_linear_zones_meet_their_ends(kernel, delta):
    words = list(TUNINGS["paper"].calibration().words)
    for index in ZONES:
        words[index : index + 2] = delta, log2_q22(delta)
    calibration = type(TUNINGS["paper"].calibration())(k.LAW_ADRC, tuple(words))
    errors_um = sorted({e * 10**6 // 2**31 for e in at_the_roots(delta)})
    setpoints = np.array([sign * 10 * e % 2**31 for e in errors_um for sign in (1, -1)], np.int64)
    positions = np.array(list(itertools.islice(itertools.cycle((0, 1, -1)), len(setpoints))), np.int32)
    assert_same_bits(kernel, [Segment(calibration, k.LAW_ADRC, setpoints.astype(np.int32), positions)])
