"""Chambers, pumps, valves and accumulator, and where the printed equations cannot be meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_sim import PlantParameters, advance, initial_state, simulate
from plant_sim import layout as at
from plant_sim.hydraulics import accumulator_pressure, chamber_inflow, chamber_volumes

P = PlantParameters()
VECTOR = P.vector()
LINE_PA = 3.2e5
PRESSURE_PA = st.floats(1e5, 6e5) | st.floats(-5e5, 3e7)


def inflow(pressure, pump_flow=0.0, pump_loss=0.0):
    offset, slope, _, _ = chamber_inflow(pressure, pump_flow, pump_loss, LINE_PA, VECTOR)
    return offset + slope * (pressure - LINE_PA)


def test_chamber_b_shrinks_as_the_rod_extends():
    """Eq. (6) prints V2 growing with x, as if the piston made room on both of its sides."""
    assert chamber_volumes(0.0, VECTOR) == pytest.approx((2e-6, 2e-6 + P.annulus_area_m2 * 0.4))
    assert chamber_volumes(0.4, VECTOR) == pytest.approx((2e-6 + P.piston_area_m2 * 0.4, 2e-6))


def test_extending_the_rod_displaces_exactly_its_own_volume():
    added = sum(chamber_volumes(0.3, VECTOR)) - sum(chamber_volumes(0.1, VECTOR))
    assert added == pytest.approx(P.rod_area_m2 * 0.2)


def test_pulling_the_rod_out_compresses_chamber_b_and_relaxes_chamber_a():
    """Eq. (4) prints dp_B/dt with the opposite sign: the pulled rod would find no resistance."""
    parameters = PlantParameters(leak_m3_per_s_pa=0.0)
    p = parameters.vector()
    state = initial_state(parameters, 0.3)
    before = state.copy()
    for _ in range(10):
        advance(state, p, 0.0, -500.0, 1e-3, 10)
    moved, rise_a, rise_b = (state - before)[[at.POSITION, at.PRESSURE_A, at.PRESSURE_B]]
    volume_a, volume_b = chamber_volumes(0.3, p)
    assert moved > 1e-5
    assert rise_a == pytest.approx(-P.bulk_modulus_pa * P.piston_area_m2 * moved / volume_a, rel=1e-3)
    assert rise_b == pytest.approx(P.bulk_modulus_pa * P.annulus_area_m2 * moved / volume_b, rel=1e-3)


def test_pump_loss_runs_from_high_to_low_pressure():
    flow, loss = 1e-4, 1e-5
    assert inflow(LINE_PA + 2e5, flow, loss) - inflow(LINE_PA + 2e5, flow) == pytest.approx(-loss)
    assert inflow(LINE_PA - 1.5e5, flow, loss) - inflow(LINE_PA - 1.5e5, flow) == pytest.approx(loss)
    assert inflow(LINE_PA, flow, loss) == pytest.approx(flow)


def test_check_valve_opens_a_fifth_of_a_bar_below_the_line():
    assert inflow(LINE_PA - 0.1e5) == pytest.approx(P.leak_m3_per_s_pa * 0.1e5)
    assert inflow(LINE_PA - 0.3e5) == pytest.approx(P.check_valve_gain_m3_per_s_pa * 0.1e5, rel=0.02)


def test_relief_valve_opens_160_bar_above_the_line():
    leak = P.leak_m3_per_s_pa * 170e5
    assert inflow(LINE_PA + 170e5) == pytest.approx(-leak - P.relief_valve_gain_m3_per_s_pa * 10e5)


@given(
    pressure=PRESSURE_PA,
    other=PRESSURE_PA,
    flow=st.floats(-1e-3, 1e-3),
    loss=st.floats(0.0, 1e-4),
)
def test_inflow_falls_with_pressure_and_its_piece_holds_between_its_ends(pressure, other, flow, loss):
    offset, slope, low, high = chamber_inflow(pressure, flow, loss, LINE_PA, VECTOR)
    assert low <= pressure - LINE_PA <= high
    if low <= other - LINE_PA <= high:
        assert inflow(other, flow, loss) == pytest.approx(offset + slope * (other - LINE_PA), abs=1e-15)
    if pressure < other:
        assert inflow(pressure, flow, loss) >= inflow(other, flow, loss)


@pytest.mark.parametrize(
    ("excess_pa", "low_pa", "high_pa"),
    [
        (-2e5, -np.inf, -1e5),
        (-0.5e5, -1e5, -0.2e5),
        (0.0, -0.2e5, 1e5),
        (5e5, 1e5, 160e5),
        (170e5, 160e5, np.inf),
    ],
)
def test_a_piece_ends_where_a_valve_opens_or_the_loss_is_complete(excess_pa, low_pa, high_pa):
    assert chamber_inflow(LINE_PA + excess_pa, 0.0, 1e-5, LINE_PA, VECTOR)[2:] == (low_pa, high_pa)


@given(
    excess_pa=st.floats(-3e5, 3e5),
    relief_pa=st.sampled_from([0.0, 0.5e5, 1e5, 2e5]),
    loss=st.floats(0.0, 1e-4),
)
def test_the_pieces_meet_wherever_the_relief_valve_opens(excess_pa, relief_pa, loss):
    """Also where it opens before the loss is complete: a stuck relief valve."""
    p = PlantParameters(relief_valve_crack_pa=relief_pa).vector()
    offset, slope, low, high = chamber_inflow(LINE_PA + excess_pa, 0.0, loss, LINE_PA, p)
    excess_pa = LINE_PA + excess_pa - LINE_PA
    assert low <= excess_pa <= high
    for inside in (max(low, -4e5), min(high, 4e5)):
        direct = (
            -P.leak_m3_per_s_pa * inside
            - loss * min(max(inside / 1e5, -1.0), 1.0)
            + P.check_valve_gain_m3_per_s_pa * max(0.0, -P.check_valve_crack_pa - inside)
            - P.relief_valve_gain_m3_per_s_pa * max(0.0, inside - relief_pa)
        )
        assert offset + slope * inside == pytest.approx(direct, abs=1e-15)


def test_accumulator_holds_its_precharge_and_follows_the_polytrope():
    assert accumulator_pressure(0.0, VECTOR) == pytest.approx(3.5e5)
    assert accumulator_pressure(-1.3e-3, VECTOR) == pytest.approx(3.5e5 / 2**1.3)


def test_accumulator_gives_the_volume_that_the_rod_displaces():
    """What the chambers hold more, swept or compressed, the accumulator holds less."""
    trace = simulate(np.r_[np.full(2000, 200.0), np.full(1500, -200.0)])
    compressed = 0.0
    balance = []
    for k in range(len(trace.time_s) - 1):
        middle_m = 0.5 * (trace.position_m[k] + trace.position_m[k + 1])
        volume_a, volume_b = chamber_volumes(middle_m, VECTOR)
        rise_a = trace.pressure_a_pa[k + 1] - trace.pressure_a_pa[k]
        rise_b = trace.pressure_b_pa[k + 1] - trace.pressure_b_pa[k]
        compressed += (volume_a * rise_a + volume_b * rise_b) / P.bulk_modulus_pa
        swept = P.rod_area_m2 * (trace.position_m[k + 1] - trace.position_m[0])
        balance.append(trace.oil_volume_m3[k + 1] + swept + compressed)
    assert np.ptp(trace.oil_volume_m3) > 1.5e-4
    assert np.abs(balance).max() < 1e-9


def test_motor_ramps_at_its_limit_then_settles_exponentially():
    trace = simulate(np.full(100, 100.0))
    assert trace.motor_speed_rad_s[10] == pytest.approx(40.0)
    # the gap of 20 rad/s = acceleration · τ is left after 20 ms
    assert trace.motor_speed_rad_s[30] == pytest.approx(100.0 - 20.0 * np.exp(-2.0))


def test_motor_speed_is_limited():
    assert simulate(np.full(300, 1e4)).motor_speed_rad_s[-1] == pytest.approx(100.0 * np.pi)


def test_retracting_under_load_is_faster_by_the_loss_that_the_load_drives_through_the_pump():
    parameters = PlantParameters(leak_m3_per_s_pa=0.0)
    trace = simulate(np.full(1000, -100.0), parameters=parameters, initial_position_m=0.3)
    assert -trace.velocity_m_s[100:].mean() / 100.0 == pytest.approx(8.4e-4, rel=0.01)
