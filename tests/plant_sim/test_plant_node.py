"""The machine's node: when it samples, what it sends, and what it does with what it hears."""

import math

import numpy as np
import pytest
from plant_rig import CONTRACT, COUNTS_PER_RPM, ENABLE, PERIOD_NS, RAD_S_PER_COUNT, SHUTDOWN, SWITCH_ON, Rig

from dbc.messages import BenchCommand
from plant_sim.drive import State
from plant_sim.equilibrium import initial_state
from plant_sim.node import Plant
from plant_sim.open_loop import simulate
from plant_sim.parameters import PlantParameters
from plant_sim.sensors import PositionSensor

PARAMETERS = PlantParameters()
FULL_SPEED = 3000 * COUNTS_PER_RPM


@pytest.fixture
def enabled() -> Rig:
    """Mid-stroke at rest, the drive in Operation enabled."""
    rig = Rig()
    rig.enable(0.15)
    return rig


# sampling


def test_it_samples_and_sends_at_the_start_of_each_period(enabled):
    for _ in range(5):
        now_ns = enabled.now_ns
        record = enabled.period(400)
        assert record["time_ns"] == now_ns
        assert all(send_ns == now_ns for send_ns, _ in enabled.sent)
        assert enabled.decoded("position_feedback") == (0, math.floor(record["position_m"] * 1e6 + 0.5))


def test_it_powers_on_at_a_whole_period():
    assert Plant(CONTRACT, PARAMETERS).on_start(1_234_567).wake_ns == 2_000_000


def test_it_starts_retracted_at_rest_in_equilibrium():
    rig, equilibrium = Rig(), initial_state(PARAMETERS)
    record = rig.period()
    assert (record["position_m"], record["velocity_m_s"], record["motor_speed_rad_s"]) == (
        equilibrium[0],
        0.0,
        0.0,
    )
    assert record["drive_state"] == State.SWITCH_ON_DISABLED


def test_a_late_timer_catches_up_the_periods_it_missed(enabled):
    for _ in range(20):
        enabled.period(4000)
    twin = Rig()
    twin.enable(0.15)
    for _ in range(17):
        twin.period(4000)
    twin.now_ns += 2 * PERIOD_NS
    assert twin.plant.on_timer(twin.now_ns).wake_ns == twin.now_ns + PERIOD_NS
    late = twin.plant.record.columns_by_name()["position_m"][-1]
    assert late == enabled.plant.record.columns_by_name()["position_m"][-1]


def test_feedback_is_protected_with_a_running_counter(enabled):
    check = CONTRACT.position_feedback.checker().check
    statuses = []
    for _ in range(40):
        enabled.period(0)
        statuses.append(check(enabled.sent[0][1].data).name)
    assert statuses == ["INITIAL"] + ["OK"] * 39


def test_the_sensor_given_is_the_one_that_is_read():
    rig = Rig(PositionSensor(lsb_m=10e-6))
    rig.bench_reset(0.123_456)
    rig.period()
    assert rig.decoded("position_feedback") == (0, 123_460)


# the command


def test_a_command_is_latched_at_the_next_period_and_held_for_one(enabled):
    """Command heard before t_k acts from t_k on: on the state first at t_k+1."""
    before = enabled.period(0)
    taken = enabled.period(4000)
    assert taken["speed_command_rad_s"] == pytest.approx(4000 * RAD_S_PER_COUNT)
    assert taken["motor_speed_rad_s"] == before["motor_speed_rad_s"] == 0.0
    after = enabled.period(0)
    assert after["motor_speed_rad_s"] > 0.0
    assert after["speed_command_rad_s"] == 0.0


@pytest.mark.parametrize("delay_periods", [1, 2, 3])
def test_a_drive_with_more_delay_latches_one_or_two_periods_later(delay_periods):
    rig = Rig(delay_periods=delay_periods)
    rig.bench_reset(0.15)
    for controlword in (SHUTDOWN, SHUTDOWN, SWITCH_ON, ENABLE):
        rig.period(0, controlword)
    commands = [100, 200, 300, 400, 500, 600]
    taken = [round(rig.period(counts)["speed_command_rad_s"] / RAD_S_PER_COUNT) for counts in commands]
    later = delay_periods - 1
    assert taken == [0] * later + commands[: len(commands) - later]


def test_a_reset_forgets_the_commands_that_wait():
    rig = Rig(delay_periods=3)
    for _ in range(3):
        rig.period(0, SHUTDOWN)
    rig.bench_reset(0.15)
    states = [rig.period(0, SHUTDOWN)["drive_state"] for _ in range(3)]
    assert states == [State.SWITCH_ON_DISABLED] * 2 + [State.READY_TO_SWITCH_ON]


def test_of_two_commands_in_a_period_the_newest_counts(enabled):
    enabled.hear(enabled.command_frame(ENABLE, 100))
    assert enabled.period(200)["speed_command_rad_s"] == pytest.approx(200 * RAD_S_PER_COUNT)


def test_the_machine_moves_as_the_open_loop_simulation_does():
    """Same commands, same instants: the node adds nothing to the plant."""
    rig = Rig()
    for controlword in (SHUTDOWN, SHUTDOWN, SWITCH_ON):
        rig.period(0, controlword)
    commands = [round(3000 * math.sin(0.02 * k) ** 2) for k in range(300)]
    load = np.zeros(len(commands))
    rows = []
    for k, counts in enumerate(commands):
        if k == 100:  # after the timer of t_100, as a supervisor's would
            load[100:] = 500.0
        rows.append(rig.period(counts))
        if k == 100:
            rig.load(500)
    # three periods of standing at the equilibrium come first
    speed = np.concatenate([np.zeros(3), np.array(commands) * RAD_S_PER_COUNT])
    trace = simulate(speed, np.concatenate([np.zeros(3), load]))
    for name in ("position_m", "velocity_m_s", "pressure_a_pa", "pressure_b_pa", "motor_speed_rad_s"):
        assert [row[name] for row in rows] == getattr(trace, name)[3:].tolist()


# supervision

LIMIT_RAD_S2 = PARAMETERS.motor_acceleration_rad_s2


def spin_up(rig: Rig, counts: int) -> dict[str, float]:
    for _ in range(200):
        record = rig.period(counts)
    assert record["motor_speed_rad_s"] == pytest.approx(counts * RAD_S_PER_COUNT, rel=1e-3)
    return record


def wrong_crc(rig: Rig) -> None:
    frame = rig.command_frame(ENABLE, FULL_SPEED)
    rig.hear(frame._replace(data=frame.data ^ 1 << 40))


def wrong_dlc(rig: Rig) -> None:
    frame = rig.command_frame(ENABLE, FULL_SPEED)
    rig.hear(frame._replace(dlc=8))


def frozen(rig: Rig) -> None:
    rig.hear(rig.frozen_frame)


def missing(rig: Rig) -> None:
    rig.command_frame(ENABLE, FULL_SPEED)


BAD = (missing, wrong_crc, wrong_dlc, frozen)


@pytest.mark.parametrize("counts", [FULL_SPEED, FULL_SPEED // 2, -FULL_SPEED // 2])
def test_three_missing_commands_stop_the_motor_from_then_within_w_over_a(counts):
    rig = Rig()
    rig.bench_reset(0.05 if counts > 0 else 0.35)
    for controlword in (SHUTDOWN, SHUTDOWN, SWITCH_ON):
        rig.period(0, controlword)
    speed_rad_s = abs(spin_up(rig, counts)["motor_speed_rad_s"])
    states = [rig.period()["drive_state"] for _ in range(3)]
    assert states == [State.OPERATION_ENABLED] * 2 + [State.FAULT_REACTION_ACTIVE]
    assert rig.now_ns > 0
    ramp_periods = math.ceil(speed_rad_s / LIMIT_RAD_S2 * 1000)
    assert ramp_periods <= 79
    for _ in range(ramp_periods):
        record = rig.period()
    assert record["speed_command_rad_s"] == 0.0
    assert record["drive_state"] == State.FAULT
    for _ in range(16):  # the motor follows with its lag of 5 ms
        record = rig.period()
    assert abs(record["motor_speed_rad_s"]) < 0.05 * speed_rad_s


@pytest.mark.parametrize("bad", BAD)
def test_the_third_invalid_command_is_as_good_as_missing(enabled, bad):
    enabled.frozen_frame = enabled.command_frame(ENABLE, 400)
    enabled.hear(enabled.frozen_frame)
    enabled.period()
    for expected in (State.OPERATION_ENABLED, State.OPERATION_ENABLED, State.FAULT_REACTION_ACTIVE):
        bad(enabled)
        assert enabled.period()["drive_state"] == expected


@pytest.mark.parametrize("bad", BAD)
def test_two_bad_commands_hold_the_last_target_and_are_forgiven(enabled, bad):
    for _ in range(10):
        enabled.frozen_frame = enabled.command_frame(ENABLE, 400)
        enabled.hear(enabled.frozen_frame)
        assert enabled.period()["drive_state"] == State.OPERATION_ENABLED
        for _ in range(2):
            bad(enabled)
            record = enabled.period()
            assert record["drive_state"] == State.OPERATION_ENABLED
            assert record["speed_command_rad_s"] == pytest.approx(400 * RAD_S_PER_COUNT)


def test_a_lost_command_shows_in_the_statusword(enabled):
    for _ in range(30):
        enabled.period()
        if status := enabled.decoded("drive_status"):
            statusword = status[0]
    assert statusword & 0x4F == 0x08


# bench channel


def test_a_load_acts_for_the_whole_period_in_which_it_arrives(enabled):
    twin = Rig()
    twin.enable(0.15)
    enabled.load(-2000)  # heard between t_3 and t_4
    with_load, without = enabled.period(0), twin.period(0)
    assert with_load["velocity_m_s"] > without["velocity_m_s"]

    start = initial_state(PARAMETERS, 0.15)
    from plant_sim.integrator import advance

    vector = PARAMETERS.vector()
    for force_n in (0.0, 0.0, 0.0, -2000.0):
        advance(start, vector, 0.0, force_n, 1e-3, 10)
    assert with_load["position_m"] == start[0]


def test_a_load_stays_until_the_next_one(enabled):
    enabled.load(-2000)
    for _ in range(10):
        assert enabled.period(0)["load_n"] == -2000.0
    enabled.load(0)
    assert enabled.period(0)["load_n"] == 0.0


@pytest.mark.parametrize("position_m", [0.0, 0.0003, 0.15, 0.4])
def test_a_reset_puts_the_rod_to_a_position_at_rest_with_the_drive_off(enabled, position_m):
    enabled.load(-1000)
    for _ in range(50):
        enabled.period(4000)
    enabled.bench_reset(position_m)
    record = enabled.period()
    assert record["position_m"] == pytest.approx(position_m, abs=20e-6)
    assert abs(record["velocity_m_s"]) < 5e-3  # with the motor at rest it creeps by its leaks
    assert record["motor_speed_rad_s"] == 0.0
    assert record["load_n"] == 0.0
    assert record["drive_state"] == State.SWITCH_ON_DISABLED


def test_an_empty_bench_command_does_not_move_the_rod(enabled):
    bench = CONTRACT.bench_control
    enabled.hear(bench.frame(bench.pack(BenchCommand.NONE, 1, 1)))
    record = enabled.period(0)
    assert record["position_m"] == pytest.approx(0.15, abs=1e-6)
    assert record["drive_state"] == State.OPERATION_ENABLED


@pytest.mark.parametrize("position_m", [-0.5, 0.5, 0.999])
def test_a_reset_beyond_the_stops_does_not_break_the_machine(enabled, position_m):
    enabled.bench_reset(position_m)
    for _ in range(200):
        record = enabled.period()
    assert all(math.isfinite(value) for value in record.values())


@pytest.mark.parametrize("force_n", [-(2**31), -1_000_000, 1_000_000, 2**31 - 1])
def test_an_absurd_load_does_not_break_the_machine(enabled, force_n):
    enabled.load(force_n)
    for _ in range(200):
        record = enabled.period(0)
    assert all(math.isfinite(value) for value in record.values())


# cadence


def test_status_and_pressures_take_turns_every_10_ms_and_never_share_a_period(enabled):
    periods = {"drive_status": [], "pressure_feedback": []}
    for _ in range(100):
        at_ms = enabled.now_ns // PERIOD_NS
        enabled.period(0)
        assert enabled.decoded("position_feedback") is not None
        for name, seen in periods.items():
            if enabled.decoded(name) is not None:
                seen.append(at_ms)
    for seen in periods.values():
        assert len(seen) == 10
        assert set(np.diff(seen)) == {10}
    assert not set(periods["drive_status"]) & set(periods["pressure_feedback"])


def test_what_it_reports_is_what_it_simulates(enabled):
    for _ in range(60):
        record = enabled.period(4000)
        if status := enabled.decoded("drive_status"):
            assert status[1] == round(record["motor_speed_rad_s"] / RAD_S_PER_COUNT)
        if pressures := enabled.decoded("pressure_feedback"):
            names = ("pressure_a_pa", "pressure_b_pa", "pressure_accumulator_pa")
            assert pressures == tuple(math.floor(record[name] / 1000 + 0.5) for name in names)


def test_it_sends_only_what_it_says_it_transmits(enabled):
    sent = set()
    for _ in range(20):
        enabled.period(0)
        sent |= {frame.can_id for _, frame in enabled.sent}
    assert sent == enabled.plant.transmits
    assert enabled.plant.latched == enabled.plant.accepts
