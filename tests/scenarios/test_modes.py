"""Enable, disable, recover, restart."""

import pytest
from acceptance import (
    AT_REST_RPM,
    MOTOR_LAG_S,
    cruise,
    faults,
    hold_here,
    reaction,
    state_changes,
    undisturbed,
)

from firmware_py.diagnosis import State
from hil.references import sine
from plant_sim.drive import State as Drive

power = pytest.mark.needs("power")
virtual_time = pytest.mark.needs("virtual_time")


def at_rest(bench, since_s: float) -> bool:
    return bench.motor_speed_rpm.between(since_s).max < AT_REST_RPM


def drive_state(bench) -> Drive:
    return Drive(int(bench.trace["drive_state"][-1]))


# in every mode


@pytest.mark.bench(position_m=0.1)
def test_disabling_stops_the_motor(bench):
    bench.setpoint(cruise)
    bench.run(0.2)
    bench.disable()
    bench.run(0.25)
    assert at_rest(bench, since_s=0.4)
    assert bench.controller_state == State.STANDBY
    assert faults(bench) == set()


@pytest.mark.bench(position_m=0.1)
def test_nothing_moves_without_enable(bench):
    bench.disable()
    bench.run(0.1)
    bench.setpoint(0.15)
    bench.run(0.25)
    assert at_rest(bench, since_s=0.15)
    assert bench.controller_state == State.STANDBY


@pytest.mark.bench(position_m=0.1)
def test_enabled_again_it_holds_its_position(bench):
    bench.disable()
    bench.run(0.1)
    hold_here(bench)
    bench.enable()
    bench.run(0.4)
    assert bench.controller_state == State.RUN
    assert undisturbed(bench, bench.error_mm.between(0.3)).max < 0.2


@pytest.mark.bench(position_m=0.1)
def test_without_setpoints_it_is_in_the_safe_state(bench):
    bench.setpoint(cruise)
    bench.run(0.2)
    bench.silence("PositionSetpoint")
    bench.run(0.25)
    assert bench.controller_state == State.SAFE
    assert faults(bench) == {"SetpointLost"}
    assert at_rest(bench, since_s=0.4)


@pytest.mark.bench(position_m=0.1)
def test_without_mode_commands_it_is_in_the_safe_state(bench):
    bench.run(0.05)
    bench.silence("ControllerCommand")
    bench.run(0.5)
    assert bench.controller_state == State.SAFE
    assert faults(bench) == {"CommandLost"}
    assert at_rest(bench, since_s=0.45)


@pytest.mark.bench(position_m=0.1)
def test_it_recovers_from_the_safe_state(bench):
    bench.silence("PositionSetpoint")
    bench.run(0.05)
    bench.unsilence("PositionSetpoint")
    bench.recover()
    bench.run(0.1)
    hold_here(bench)
    bench.enable()
    bench.run(0.35)
    assert bench.controller_state == State.RUN
    assert faults(bench) == set()
    assert undisturbed(bench, bench.error_mm.between(0.4)).max < 0.2


@pytest.mark.bench(controller="pi")
def test_the_law_asked_for_is_in_use(bench):
    bench.setpoint(sine)
    bench.run(0.25)
    assert bench.signal("ControllerStatus.ControlLaw").last == 2


def test_a_new_run_begins_where_it_is_told_to(bench_at):
    first = bench_at(position_m=0.05)
    first.setpoint(lambda time_s: 0.05 + 0.05 * time_s)
    first.run(0.15)
    second = bench_at(position_m=0.2)
    second.run(0.4)
    assert second.controller_state == State.RUN
    assert faults(second) == set()
    assert undisturbed(second, second.position_mm.between(0.2)).last == pytest.approx(200.0, abs=0.2)


# in virtual time


@virtual_time
def test_disabled_in_the_midst_of_a_move_the_motor_stops_at_once(moving):
    moving.disable()
    moving.run(0.3)
    stop = reaction(moving, since_s=0.5)
    assert stop.at_rest_s < 0.003 + stop.ramp_s + MOTOR_LAG_S
    assert state_changes(moving) == [State.RUN, State.STANDBY]


@virtual_time
@pytest.mark.bench(position_m=0.1)
def test_the_safe_state_is_not_left_by_enabling(bench):
    bench.silence("PositionSetpoint")
    bench.run(0.05)
    bench.unsilence("PositionSetpoint")
    bench.disable()
    bench.run(0.1)
    bench.enable()
    bench.run(0.2)
    assert bench.controller_state == State.SAFE
    assert at_rest(bench, since_s=0.1)


@virtual_time
@pytest.mark.parametrize(("law", "number"), [("p", 1), ("pi", 2), ("adrc", 3)])
def test_every_law_reports_itself(bench_at, law, number):
    bench = bench_at(controller=law)
    bench.run(0.25)
    assert bench.signal("ControllerStatus.ControlLaw").last == number


@power
def test_the_motor_stops_when_the_firmware_dies(moving):
    moving.power_off("controller")
    moving.run(0.3)
    stop = reaction(moving, since_s=0.5)
    assert stop.at_rest_s < 0.004 + stop.ramp_s + MOTOR_LAG_S
    assert drive_state(moving) == Drive.FAULT


@power
def test_the_controller_is_safe_when_the_plant_dies(moving):
    moving.power_off("plant")
    moving.run(0.05)
    assert moving.controller_state == State.SAFE
    assert moving.controller_faults == {"FeedbackLost", "DriveStatusLost"}
    assert moving.signal("DriveCommand.TargetVelocity").between(0.5 + 0.004).max == 0.0


@power
def test_a_restarted_controller_does_not_move_on_an_enable_held_all_along(moving):
    moving.power_on("controller")
    moving.run(0.5)
    assert moving.controller_state == State.STANDBY
    assert at_rest(moving, since_s=0.6)


@power
def test_a_restarted_controller_moves_after_enable_was_withdrawn(moving):
    moving.power_on("controller")
    moving.run(0.2)
    moving.disable()
    moving.run(0.1)
    hold_here(moving)
    moving.enable()
    moving.run(0.3)
    assert moving.controller_state == State.RUN
    assert moving.error_mm.between(1.0).max < 0.05


@power
def test_a_drive_that_faulted_without_its_controller_can_be_reset(moving):
    moving.power_off("controller")
    moving.run(0.2)
    moving.power_on("controller")
    moving.run(0.2)
    assert drive_state(moving) == Drive.FAULT
    moving.recover()
    moving.run(0.1)
    assert drive_state(moving) == Drive.READY_TO_SWITCH_ON
    hold_here(moving)
    moving.enable()
    moving.run(0.3)
    assert moving.controller_state == State.RUN


@power
@pytest.mark.bench(position_m=0.1)
def test_a_restarted_drive_makes_the_controller_safe(bench):
    bench.run(0.1)
    bench.power_on("plant")
    bench.run(0.2)
    assert bench.controller_state == State.SAFE
    assert bench.controller_faults == {"DriveNotEnabled"}
    assert at_rest(bench, since_s=0.15)


@power
@pytest.mark.bench(position_m=0.1)
def test_after_a_restart_of_the_plant_it_recovers(bench):
    bench.power_off("plant")
    bench.run(0.1)
    bench.power_on("plant")
    bench.recover()
    bench.run(0.1)
    hold_here(bench)
    bench.enable()
    bench.run(0.3)
    assert bench.controller_state == State.RUN
    assert bench.controller_faults == set()
    assert bench.error_mm.between(0.4).max < 0.05
