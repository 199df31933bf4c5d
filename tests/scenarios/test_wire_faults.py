"""Frames that are lost, corrupted, repeated or late."""

import numpy as np
import pytest
from acceptance import MOTOR_LAG_S, PERIOD_S, reaction

from firmware_py.diagnosis import State
from hil.signals import Series
from plant_sim.drive import State as Drive

pytestmark = pytest.mark.needs("wire_faults")

SPOIL = {
    "lost": lambda bench, message, count: bench.drop(message, count),
    "corrupt": lambda bench, message, count: bench.corrupt(message, bit=20, count=count),
    "repeated": lambda bench, message, count: bench.repeat(message, count),
}
MESSAGES = ("PositionFeedback", "PositionSetpoint", "DriveCommand", "DriveStatus")
SUPERVISED = {  # cycle in periods, fault that is reported
    "PositionFeedback": (1, "Feedback"),
    "PositionSetpoint": (1, "Setpoint"),
    "DriveStatus": (10, "DriveStatus"),
}
kinds = pytest.mark.parametrize("kind", SPOIL)


@kinds
@pytest.mark.parametrize("message", MESSAGES)
def test_two_frames_in_a_row_are_bridged(moving, message, kind):
    SPOIL[kind](moving, message, 2)
    moving.run(0.3)
    assert moving.controller_state == State.RUN
    assert moving.controller_faults == set()
    assert moving.error_mm.between(0.5).max < 0.1


@kinds
@pytest.mark.parametrize("message", SUPERVISED)
def test_three_frames_in_a_row_stop_the_machine(moving, message, kind):
    cycle_periods, name = SUPERVISED[message]
    SPOIL[kind](moving, message, 3)
    moving.run(0.3)
    stop = reaction(moving, since_s=0.5)
    assert stop.safe_s <= 3 * cycle_periods * PERIOD_S
    assert stop.at_rest_s < stop.safe_s + 2 * PERIOD_S + stop.ramp_s + MOTOR_LAG_S
    assert moving.controller_faults == {f"{name}Lost"} | ({f"{name}Corrupt"} if kind != "lost" else set())


@kinds
def test_three_commands_in_a_row_make_the_drive_stop_itself(moving, kind):
    SPOIL[kind](moving, "DriveCommand", 3)
    moving.run(0.3)
    stop = reaction(moving, since_s=0.5)
    assert stop.at_rest_s < 4 * PERIOD_S + stop.ramp_s + MOTOR_LAG_S
    assert moving.trace["drive_state"][-1] == Drive.FAULT
    assert int(moving.signal("DriveStatus.Statusword").last) & 0x08
    assert moving.controller_state == State.SAFE
    assert moving.controller_faults == {"DriveNotEnabled", "DriveFault"}


def test_a_drive_fault_is_reset_on_request_only(moving):
    moving.drop("DriveCommand", 3)
    moving.run(0.2)
    moving.disable()
    moving.run(0.1)
    moving.enable()
    moving.run(0.1)
    assert moving.trace["drive_state"][-1] == Drive.FAULT
    moving.recover()
    moving.run(0.1)
    moving.setpoint(moving.position_mm.last * 1e-3)
    moving.enable()
    moving.run(0.2)
    assert moving.controller_state == State.RUN
    assert moving.trace["drive_state"][-1] == Drive.OPERATION_ENABLED


@pytest.mark.parametrize("message", ["PositionFeedback", "PositionSetpoint"])
def test_a_frame_that_the_next_one_overtakes_is_not_used(moving, message):
    moving.delay(message, 1.2 * PERIOD_S)
    moving.run(0.2)
    assert moving.controller_state == State.RUN
    assert moving.controller_faults == {"MailboxOverrun"}
    assert moving.error_mm.between(0.5).max < 0.1


def test_feedback_that_is_steadily_late_by_less_than_a_period_is_used(moving):
    moving.delay("PositionFeedback", 0.5 * PERIOD_S, count=100)
    moving.run(0.2)
    assert moving.controller_state == State.RUN
    assert moving.error_mm.between(0.5).max < 0.2


def test_feedback_that_is_late_by_many_periods_counts_as_lost(moving):
    moving.delay("PositionFeedback", 5 * PERIOD_S, count=20)
    moving.run(0.3)
    assert reaction(moving, since_s=0.5).safe_s <= 3 * PERIOD_S
    assert "FeedbackLost" in moving.controller_faults


def test_a_command_that_misses_its_latch_is_bridged(moving):
    moving.delay("DriveCommand", 0.5 * PERIOD_S)
    moving.run(0.2)
    assert len(moving.timing.missed_periods) == 1
    assert moving.controller_state == State.RUN
    assert moving.error_mm.between(0.5).max < 0.1


@pytest.mark.bench(position_m=0.1)
def test_two_lost_mode_commands_are_bridged(bench):
    bench.drop("ControllerCommand", 2)
    bench.run(0.5)
    assert bench.controller_state == State.RUN


@pytest.mark.bench(position_m=0.1)
def test_three_corrupt_mode_commands_are_reported(bench):
    bench.corrupt("ControllerCommand", bit=16, count=3)
    bench.run(0.5)
    assert bench.controller_state == State.SAFE
    assert bench.controller_faults == {"CommandLost", "CommandCorrupt"}


def test_a_stuck_sensor_stops_the_machine(moving):
    moving.inject("sensor_stuck")
    moving.run(1.0)
    asked_rpm = Series(moving.trace["time_s"], np.abs(moving.trace["target_velocity_rpm"]))
    fast_s = asked_rpm.time_s[asked_rpm.values >= 1500][0]
    stop = reaction(moving, since_s=fast_s)
    assert stop.safe_s == pytest.approx(50 * PERIOD_S, abs=0.5 * PERIOD_S)
    assert moving.controller_faults == {"PositionStuck"}
    assert moving.error_mm.between(0.5, fast_s + stop.at_rest_s).max < 20
