"""Whatever the bus commands and the load does, the plant stays finite and above vapour pressure."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_sim import PlantParameters, simulate

RUN_S = 20.0
SPEED_RPM = st.floats(-3000.0, 3000.0) | st.sampled_from([-3000.0, 0.0, 3000.0])
LOAD_N = st.floats(-20000.0, 20000.0) | st.sampled_from([-20000.0, 0.0, 20000.0])
SCALES = st.fixed_dictionaries(
    {
        "mass": st.floats(0.5, 1.5),
        "bulk_modulus": st.floats(0.3, 1.5),
        "efficiency": st.floats(0.8, 1.1),
        "leak": st.floats(0.0, 2.5),
        "motor_time_constant": st.floats(0.4, 4.0),
        "motor_acceleration": st.floats(0.5, 1.0),
    }
)


@settings(max_examples=30, deadline=None)
@given(
    levels=st.lists(st.tuples(SPEED_RPM, LOAD_N), min_size=1, max_size=12),
    hold_ms=st.sampled_from([1, 7, 22, 150, 2000]),
    start=st.floats(0.0, 1.0),
    scales=SCALES,
)
def test_any_command_and_load_for_twenty_seconds(levels, hold_ms, start, scales):
    parameters = PlantParameters().scaled(**scales)
    periods = int(RUN_S * 1000)
    speed_rpm, load_n = np.array(levels)[np.arange(periods) // hold_ms % len(levels)].T
    trace = simulate(
        speed_rpm * np.pi / 30.0,
        load_n,
        parameters=parameters,
        initial_position_m=start * parameters.stroke_m,
    )
    for values in (trace.position_m, trace.velocity_m_s, trace.oil_volume_m3, trace.motor_speed_rad_s):
        assert np.isfinite(values).all()
    for pressure_pa in (trace.pressure_a_pa, trace.pressure_b_pa, trace.pressure_accumulator_pa):
        assert (pressure_pa >= parameters.vapour_pressure_pa).all()
        assert pressure_pa.max() < 400e5
    assert trace.position_m.min() > -0.005
    assert trace.position_m.max() < parameters.stroke_m + 0.005


def lowest_pressure_pa(parameters, reversals_hz):
    """Full speed and 20 kN, both reversing at resonance."""
    direction = np.sign(np.sin(2.0 * np.pi * reversals_hz * np.arange(3000) * 1e-3) + 1e-9)
    trace = simulate(
        100.0 * np.pi * direction, 20000.0 * direction, parameters=parameters, initial_position_m=0.2
    )
    return min(trace.pressure_a_pa.min(), trace.pressure_b_pa.min())


def test_check_valves_alone_prevent_cavitation_in_the_nominal_machine():
    nominal = PlantParameters()
    assert lowest_pressure_pa(nominal, 22.0) > 5.0 * nominal.vapour_pressure_pa


def test_soft_oil_in_resonance_reaches_vapour_pressure_and_stays_there():
    soft = PlantParameters().scaled(bulk_modulus=0.3)
    assert lowest_pressure_pa(soft, 12.0) == soft.vapour_pressure_pa
