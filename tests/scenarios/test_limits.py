"""What the machine must never be asked to do."""

import numpy as np
import pytest

from firmware_py.diagnosis import State

pytestmark = pytest.mark.needs("virtual_time")


@pytest.mark.bench(position_m=0.1)
def test_a_large_step_does_not_overspeed_the_motor(bench):
    bench.setpoint(0.2)
    bench.run(1.5)
    assert bench.signal("DriveCommand.TargetVelocity").max <= 3000.0
    assert bench.motor_speed_rpm.max <= 3000.0
    assert bench.error_mm.between(1.2).max < 0.05


@pytest.mark.bench(controller="pi", position_m=0.02)
def test_a_step_over_the_stroke_does_not_overspeed_the_motor_under_pi(bench):
    bench.setpoint(0.35)
    bench.run(0.6)
    assert bench.signal("DriveCommand.TargetVelocity").max <= 3000.0
    assert bench.motor_speed_rpm.max <= 3000.0
    assert bench.signal("ControllerStatus.Saturations").last == 0


@pytest.mark.bench(position_m=0.39)
def test_an_implausible_setpoint_is_not_followed(bench):
    bench.setpoint(0.402)
    bench.run(0.3)
    assert bench.controller_state == State.SAFE
    assert bench.controller_faults == {"SetpointLost", "SetpointInvalid"}
    assert bench.position_mm.values.max() < 391.0


@pytest.mark.bench(position_m=0.39)
def test_pressing_against_the_end_stop_is_ended(bench):
    bench.setpoint(0.4005)
    bench.run(1.5)
    assert bench.controller_state == State.SAFE
    assert bench.controller_faults == {"PositionStuck"}
    assert bench.position_mm.values.max() < 401.0
    assert bench.trace["pressure_a_bar"].max() < 170.0


@pytest.mark.bench(position_m=0.2)
def test_a_step_to_the_end_of_the_stroke_arrives(bench):
    bench.setpoint(0.3999)
    bench.run(2.0)
    assert bench.position_mm.values.max() < 401.0
    assert bench.error_mm.between(1.5).max < 0.5


@pytest.mark.bench(position_m=0.05)
def test_a_step_to_the_retracted_end_arrives(bench):
    bench.setpoint(0.0)
    bench.run(1.0)
    assert np.min(bench.position_mm.values) > -1.0
    assert bench.error_mm.between(0.8).max < 0.2
