"""What each fault that the bench sets does to the machine, against physics worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plant_rig import CONTRACT, COUNTS_PER_RPM, SHUTDOWN, SWITCH_ON, Rig

from dbc.messages import BenchFault, BenchParameter
from plant_sim.parameters import NOMINAL, PlantParameters

P = PlantParameters()
AREA_A, AREA_ROD = math.pi / 4 * 0.060**2, math.pi / 4 * 0.030**2
D_A = 13.03e-6 / (2 * math.pi)
MAX_RAW, MIN_RAW = 2**31 - 1, -(2**31)


def enabled(position_m: float = 0.15, **rig) -> Rig:
    rig = Rig(**rig)
    rig.enable(position_m)
    return rig


def run(rig: Rig, periods: int, counts: int | None = 0) -> dict[str, np.ndarray]:
    """Return the records of the next periods, and what was reported in each (NaN where nothing was)."""
    rows, reports, statuses = [], [], []
    for _ in range(periods):
        rows.append(rig.period(counts))
        status, report = rig.decoded("position_feedback") or (math.nan, math.nan)
        statuses.append(status)
        reports.append(report * 1e-6)
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return table | {"reported_m": np.array(reports), "status": np.array(statuses)}


# the sensor


def test_a_bias_shifts_what_is_reported_and_not_where_the_rod_is():
    rig, twin = enabled(), enabled()
    rig.fault(BenchFault.SENSOR_BIAS, -0.0025)
    rows, healthy = run(rig, 50, 2000), run(twin, 50, 2000)
    assert (rows["position_m"] == healthy["position_m"]).all()
    assert rows["reported_m"] - healthy["reported_m"] == pytest.approx(-0.0025, abs=1e-9)


def test_a_drift_grows_from_the_sample_in_which_it_begins():
    rig = enabled()
    rig.fault(BenchFault.SENSOR_DRIFT, 0.010)
    rows = run(rig, 101)
    error_m = rows["reported_m"] - rows["position_m"]
    assert error_m == pytest.approx(0.010 * 1e-3 * np.arange(101), abs=0.51e-6)


def test_a_drift_that_is_switched_off_leaves_no_error():
    rig = enabled()
    rig.fault(BenchFault.SENSOR_DRIFT, 0.010)
    run(rig, 100)
    rig.fault(BenchFault.SENSOR_DRIFT, 0.0)
    rows = run(rig, 1)
    assert rows["reported_m"] == pytest.approx(rows["position_m"], abs=0.51e-6)


def test_noise_has_the_strength_asked_for():
    rig = enabled()
    rig.fault(BenchFault.SENSOR_NOISE, 50e-6)
    rows = run(rig, 2000)
    error_m = rows["reported_m"] - rows["position_m"]
    assert error_m.std() == pytest.approx(50e-6, rel=0.05)
    assert abs(error_m.mean()) < 5e-6
    assert abs(np.corrcoef(error_m[1:], error_m[:-1])[0, 1]) < 0.1  # white


def test_noise_repeats_after_a_reset():
    rig = Rig()
    rig.period()
    runs = []
    for _ in range(2):
        rig.enable(0.15)
        rig.fault(BenchFault.SENSOR_NOISE, 50e-6)
        runs.append(run(rig, 50)["reported_m"])
    assert len(set(runs[0])) > 40
    assert (runs[0] == runs[1]).all()


def test_a_stuck_sensor_repeats_its_last_report_in_frames_that_are_valid():
    rig = enabled()
    check = CONTRACT.position_feedback.checker().check
    before = run(rig, 20, 4000)
    rig.fault(BenchFault.SENSOR_STUCK)
    statuses = []
    for _ in range(40):
        row = rig.period(4000)
        statuses.append(check(rig.sent[0][1].data).name)
        assert rig.decoded("position_feedback")[1] * 1e-6 == before["reported_m"][-1]
    assert statuses == ["INITIAL"] + ["OK"] * 39
    assert row["position_m"] - before["position_m"][-1] > 1e-3
    rig.fault(BenchFault.SENSOR_STUCK, 0.0)
    rows = run(rig, 1, 4000)
    assert rows["reported_m"] == pytest.approx(rows["position_m"], abs=0.51e-6)


def test_a_sensor_stuck_since_power_on_reports_zero():
    rig = Rig()
    rig.bench_reset(0.15)
    rig.fault(BenchFault.SENSOR_STUCK)
    assert run(rig, 3)["reported_m"].tolist() == [0.0] * 3


def test_a_silent_sensor_sends_nothing_and_its_counter_waits():
    rig = enabled()
    counter = rig.sent[0][1].data >> 8 & 0xF
    rig.fault(BenchFault.SENSOR_DROPOUT)
    assert np.isnan(run(rig, 30, 4000)["reported_m"]).all()
    rig.fault(BenchFault.SENSOR_DROPOUT, 0.0)
    rows = run(rig, 1)
    assert rig.sent[0][1].data >> 8 & 0xF == (counter + 1) % 16
    assert rows["reported_m"] == pytest.approx(rows["position_m"], abs=0.51e-6)


def test_a_silent_sensor_does_not_keep_the_drive_from_reporting():
    rig = enabled()
    rig.fault(BenchFault.SENSOR_DROPOUT)
    sent = set()
    for _ in range(20):
        rig.period(0)
        sent |= {frame.can_id for _, frame in rig.sent}
    assert sent == {CONTRACT.drive_status.can_id, CONTRACT.pressure_feedback.can_id}


@pytest.mark.parametrize(("asked", "reported"), [(1, 1), (2, 2), (15, 15), (99, 15), (-3, 0)])
def test_the_status_asked_for_is_the_one_reported(asked, reported):
    rig = enabled()
    rig.fault(BenchFault.SENSOR_STATUS, asked)
    rows = run(rig, 3)
    assert rows["status"].tolist() == [reported] * 3
    assert rows["reported_m"] == pytest.approx(rows["position_m"], abs=0.51e-6)


# the machine


def mode_hz(parameter: BenchParameter, factor: float) -> float:
    """Frequency of the rod on its oil columns at 0.2 m; without a leak it stands still until knocked."""
    rig = Rig(parameters=PlantParameters(leak_m3_per_s_pa=0.0))
    rig.bench_reset(0.2)
    rig.scale(parameter, factor)
    run(rig, 1000, None)
    rig.load(50)  # too little for a check valve to open
    velocity = run(rig, 300, None)["velocity_m_s"]
    before = np.flatnonzero(np.diff(np.sign(velocity)))
    crossings = before + velocity[before] / (velocity[before] - velocity[before + 1])
    return 500.0 / np.diff(crossings[1:8]).mean()


def test_softer_oil_lowers_the_mode_by_the_root_of_its_stiffness():
    assert mode_hz(BenchParameter.BULK_MODULUS, 0.5) / mode_hz(
        BenchParameter.BULK_MODULUS, 1.0
    ) == pytest.approx(math.sqrt(0.5), rel=0.01)


def test_a_heavier_crane_lowers_the_mode_by_the_root_of_its_mass():
    """At the rod J/h² + 5 kg: of the mass there all but the piston's 5 kg grows."""
    length = 0.72 + 0.2
    cos_gamma = (0.983**2 + 0.4**2 - length**2) / (2 * 0.983 * 0.4)
    lever = 0.983 * 0.4 * math.sqrt(1 - cos_gamma**2) / length
    before, after = 140.9 / lever**2 + 5.0, 1.5 * 140.9 / lever**2 + 5.0
    assert mode_hz(BenchParameter.MASS, 1.5) / mode_hz(BenchParameter.MASS, 1.0) == pytest.approx(
        math.sqrt(before / after), rel=0.01
    )


def test_a_mass_that_is_added_under_way_changes_no_velocity_at_once():
    rig = enabled()
    before = run(rig, 100, 4000)
    rig.scale(BenchParameter.MASS, 2.0)
    rows = run(rig, 3, 4000)
    velocities = np.r_[before["velocity_m_s"][-3:], rows["velocity_m_s"]]
    # 900 kg more than the oil carries: below 10 m/s², against 0.05 m/s of motion
    assert np.abs(np.diff(velocities)).max() < 10.0 * 1e-3
    assert rows["position_m"][0] > before["position_m"][-1]


def test_a_leak_raises_the_speed_at_which_a_held_load_creeps():
    """With a still motor v = -C (p_A - p_acc) / A_A."""
    speeds = {}
    for factor in (1.0, 3.0):
        rig = enabled(0.2)
        rig.scale(BenchParameter.LEAK, factor)
        rows = run(rig, 800)
        head_pa = (rows["pressure_a_pa"] - rows["pressure_accumulator_pa"])[-300:].mean()
        speeds[factor] = -rows["velocity_m_s"][-300:].mean()
        assert speeds[factor] == pytest.approx(factor * 2e-11 * head_pa / AREA_A, rel=0.02)
    assert speeds[3.0] == pytest.approx(3.0 * speeds[1.0], rel=0.03)


@pytest.mark.parametrize("factor", [1.0, 0.8, 1.1])
def test_efficiency_is_the_speed_gain(factor):
    rig = Rig()
    rig.enable(0.05)
    rig.scale(BenchParameter.LEAK, 0.0)
    rig.scale(BenchParameter.EFFICIENCY, factor)
    rows = run(rig, 1500, 4000)
    gain = (rows["velocity_m_s"][-500:] / rows["motor_speed_rad_s"][-500:]).mean()
    assert gain == pytest.approx(0.85 * factor * D_A / AREA_A, rel=0.01)


def test_more_than_full_efficiency_is_full_efficiency():
    rig, twin = Rig(), Rig(parameters=PlantParameters(volumetric_efficiency=1.0))
    rig.scale(BenchParameter.EFFICIENCY, 2.0)
    for each in (rig, twin):
        each.period()
        for controlword in (SHUTDOWN, SHUTDOWN, SWITCH_ON):
            each.period(0, controlword)
    assert run(rig, 100, 4000)["position_m"].tolist() == run(twin, 100, 4000)["position_m"].tolist()


def test_lost_precharge_takes_the_line_pressure_along_and_keeps_the_oil():
    """P = f p0 (Vg / (Vg - V))^n, at once with the old oil and for good with what the chambers gave back."""
    rig = enabled(0.3)
    before = run(rig, 1)["pressure_accumulator_pa"][0]
    assert before == pytest.approx(3.5e5 * (1.3e-3 / (1.3e-3 + 0.3 * AREA_ROD)) ** 1.3, rel=0.005)
    rig.scale(BenchParameter.PRECHARGE, 0.6)
    rows = run(rig, 300)
    after = rows["pressure_accumulator_pa"]
    assert after[0] == pytest.approx(before, rel=1e-3)  # as measured when the change takes effect
    assert after[1] == pytest.approx(0.6 * before, rel=0.005)
    swept = rows["position_m"][-1] * AREA_ROD
    # the unloaded chamber follows the line and expands: at most 1e-3 m³ · 1.4e5 Pa / 7e8 Pa = 0.2 mL of 1300
    assert after[-1] == pytest.approx(0.6 * 3.5e5 * (1.3e-3 / (1.3e-3 + swept)) ** 1.3, rel=0.005)


def test_lost_precharge_ends_at_the_pressure_of_the_air():
    rig = enabled(0.0)
    rig.scale(BenchParameter.PRECHARGE, 0.0)
    assert run(rig, 100)["pressure_accumulator_pa"][-1] == pytest.approx(1e5, rel=0.02)


def test_more_precharge_fills_the_chambers_through_the_check_valves():
    rig = enabled(0.2)
    rig.scale(BenchParameter.PRECHARGE, 3.0)
    rows = run(rig, 200)
    line_pa = rows["pressure_accumulator_pa"][-1]
    assert line_pa > 8e5
    assert rows["pressure_b_pa"][-1] > line_pa - P.check_valve_crack_pa - 0.05e5


def test_a_relief_valve_stuck_open_limits_the_pressure_to_what_the_flow_drives_through_it():
    """At the stop, motion over: η ω D = C Δp + K_r (Δp - 160 bar), stuck open η ω D = (C + K_r) Δp."""
    flow = 0.85 * 3000 * math.pi / 30 * D_A
    leak, relief = 2e-11, 3.3e-10
    heads_pa = {}
    for factor in (1.0, 0.0):
        rig = Rig()
        rig.enable(0.4)
        rig.scale(BenchParameter.RELIEF_CRACK, factor)
        rows = run(rig, 500, 3000 * COUNTS_PER_RPM)
        heads_pa[factor] = rows["pressure_a_pa"][-1] - rows["pressure_accumulator_pa"][-1]
    assert heads_pa[1.0] == pytest.approx((flow + relief * 160e5) / (leak + relief), rel=0.01)
    assert heads_pa[0.0] == pytest.approx(flow / (leak + relief), rel=0.01)


def test_a_relief_valve_stuck_open_lets_the_load_down():
    rig, healthy = enabled(0.2), enabled(0.2)
    rig.scale(BenchParameter.RELIEF_CRACK, 0.0)
    rows = run(rig, 600)
    sunk, crept = 0.2 - rows["position_m"][-1], 0.2 - run(healthy, 600)["position_m"][-1]
    assert sunk > 5 * crept


def test_a_motor_that_lost_speed_falls_short_of_what_the_drive_asks_for_and_says_so():
    rig = enabled()
    rig.scale(BenchParameter.MOTOR_SPEED, 0.5)
    rows = run(rig, 200, 3000 * COUNTS_PER_RPM)
    assert rows["motor_speed_rad_s"][-1] == pytest.approx(1500 * math.pi / 30)
    assert rows["speed_command_rad_s"][-1] == pytest.approx(3000 * math.pi / 30)
    while (status := rig.decoded("drive_status")) is None:
        rig.period(3000 * COUNTS_PER_RPM)
    assert status[1] == 1500 * COUNTS_PER_RPM
    assert status[0] & 0x0800 == 0  # the drive does not know of it: no internal limit


def test_a_motor_that_lost_acceleration_ramps_more_slowly():
    rig = enabled()
    rig.scale(BenchParameter.MOTOR_ACCELERATION, 0.25)
    speeds = run(rig, 60, 3000 * COUNTS_PER_RPM)["motor_speed_rad_s"]
    assert np.diff(speeds[5:50]) == pytest.approx(1000.0 * 1e-3)


# how it is asked for


def test_a_scaled_parameter_acts_from_the_next_period_on():
    """Heard between t_k and t_k+1: the period that ends is the old machine's, the next one the new one's."""
    rig, twin = enabled(), enabled()
    rig.scale(BenchParameter.RELIEF_CRACK, 0.0)
    assert rig.period(0) == twin.period(0)
    assert rig.period(0)["pressure_a_pa"] < twin.period(0)["pressure_a_pa"]


def test_all_that_is_asked_for_within_one_period_takes_effect_in_order():
    rig = enabled()
    rig.fault(BenchFault.SENSOR_BIAS, 0.001)
    rig.fault(BenchFault.SENSOR_STATUS, 1)
    rig.fault(BenchFault.SENSOR_BIAS, 0.002)
    rig.scale(BenchParameter.MOTOR_SPEED, 0.1)
    rig.scale(BenchParameter.MOTOR_ACCELERATION, 0.5)
    rig.load(100)
    rig.load(-300)
    rows = run(rig, 100, 4000)
    assert rows["reported_m"] - rows["position_m"] == pytest.approx(0.002, abs=0.51e-6)
    assert set(rows["status"]) == {1}
    assert rows["motor_speed_rad_s"].max() == pytest.approx(300 * math.pi / 30)
    assert np.diff(rows["motor_speed_rad_s"]).max() == pytest.approx(2.0)
    assert set(rows["load_n"]) == {-300.0}


def test_what_is_asked_for_before_a_reset_in_the_same_period_is_forgotten_what_comes_after_is_not():
    rig = Rig()
    for fault in (BenchFault.SENSOR_BIAS, BenchFault.SENSOR_STATUS):
        rig.fault(fault, 1.0)
    rig.scale(BenchParameter.MOTOR_SPEED, 0.1)
    rig.bench_reset(0.15)
    rig.fault(BenchFault.SENSOR_BIAS, 0.003)
    rows = run(rig, 1)
    assert rows["status"] == 0
    assert rows["reported_m"] == pytest.approx(0.153, abs=0.51e-6)


def break_all(rig: Rig) -> None:
    for fault in BenchFault:
        rig.fault(fault, 1.0)
    for parameter in BenchParameter:
        rig.scale(parameter, 0.5)


@pytest.mark.parametrize("restart", ["bench_reset", "power_on"])
def test_a_restart_restores_the_machine_as_built(restart):
    built = PlantParameters().scaled(leak=2.0, mass=1.2)
    rig, new = Rig(parameters=built), Rig(parameters=built)
    break_all(rig)
    run(rig, 5)
    new.period()
    if restart == "bench_reset":
        rig.bench_reset(0.0)
        new.bench_reset(0.0)
    else:
        rig.plant.on_start(rig.now_ns)
        new.plant.on_start(new.now_ns)
    broken, whole = run(rig, 40), run(new, 40)
    for name in broken.keys() - {"time_ns"}:
        assert broken[name].tolist() == whole[name].tolist(), name


def test_a_factor_is_on_the_machine_as_built_and_not_on_the_last_factor():
    rig = Rig(parameters=PlantParameters().scaled(motor_acceleration=0.5))
    rig.enable(0.15)
    for factor in (0.5, 0.5):
        rig.scale(BenchParameter.MOTOR_ACCELERATION, factor)
    speeds = run(rig, 30, 3000 * COUNTS_PER_RPM)["motor_speed_rad_s"]
    assert np.diff(speeds[5:]) == pytest.approx(1.0)


def test_none_clears_the_sensors_faults_and_factor_one_restores_a_parameter():
    rig, twin = enabled(), enabled()
    for fault in BenchFault:
        rig.fault(fault, 1.0)
    for parameter in BenchParameter:
        rig.scale(parameter, 0.5)
        rig.scale(parameter, 1.0)
    rig.fault(BenchFault.NONE)
    mended, whole = run(rig, 40, 400), run(twin, 40, 400)
    for name, column in whole.items():
        assert mended[name].tolist() == column.tolist(), name


@pytest.mark.parametrize("identifier", [0, 9, 65535])
def test_what_is_not_known_is_ignored(identifier):
    rig, twin = enabled(), enabled()
    rig.fault(identifier, 1.0)
    rig.scale(identifier, 0.5)
    assert run(rig, 20, 400)["position_m"].tolist() == run(twin, 20, 400)["position_m"].tolist()


RAW = st.integers(MIN_RAW, MAX_RAW) | st.sampled_from([MIN_RAW, -1, 0, 1, 500_000, 1_000_000, MAX_RAW])
REQUESTS = st.one_of(
    st.tuples(st.just("scale"), st.sampled_from(BenchParameter), RAW.map(lambda raw: raw * 1e-6)),
    st.tuples(st.just("fault"), st.sampled_from(BenchFault), RAW.map(lambda raw: raw * 1e-6)),
    st.tuples(st.just("load"), st.integers(-20_000, 20_000)),
)


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(
        st.tuples(st.lists(REQUESTS, max_size=4), st.integers(-3000, 3000)), min_size=1, max_size=10
    ),
    hold=st.sampled_from([3, 20, 150]),
    start_m=st.floats(0.0, 0.4),
)
def test_whatever_is_asked_for_the_machine_stays_computable(steps, hold, start_m):
    rig = Rig()
    rig.enable(start_m)
    for requests, rpm in steps:
        for name, *arguments in requests:
            getattr(rig, name)(*arguments)
        rows = run(rig, hold, rpm * COUNTS_PER_RPM)
        for name in rows.keys() - {"reported_m", "status"}:
            assert np.isfinite(rows[name]).all(), name
        assert min(rows["pressure_a_pa"].min(), rows["pressure_b_pa"].min()) >= NOMINAL.vapour_pressure_pa
        assert rows["position_m"].min() > -0.05
        assert rows["position_m"].max() < 0.45
