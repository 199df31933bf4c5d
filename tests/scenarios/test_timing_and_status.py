"""The timing of every period, and what the nodes say of themselves."""

import numpy as np
import pytest
from acceptance import PERIOD_S

from firmware_py.diagnosis import State
from hil.references import sine
from hil.scenario import TimingLimits

pytestmark = pytest.mark.needs("virtual_time")

LIMITS = TimingLimits(
    feedback_age_us=450,
    setpoint_age_us=400,
    latency_us=900,
    jitter_us=50,
    missed_periods=0,
    late_periods=0,
)


def test_every_period_is_in_time(bench):
    bench.setpoint(sine)
    bench.run(1.0)
    bench.check_timing(LIMITS)


@pytest.mark.bench(bit_rate=500_000)
def test_every_period_is_in_time_at_500_kbit_s(bench):
    bench.setpoint(sine)
    bench.run(1.0)
    bench.check_timing(LIMITS)


@pytest.mark.bench(bit_rate=500_000)
def test_the_bus_has_room_at_500_kbit_s(bench):
    bench.setpoint(sine)
    bench.run(1.0)
    assert bench.result("bus load")["bus_load_percent"] < 85.0


def test_every_period_is_in_time_under_load_changes(bench):
    bench.setpoint(sine)
    for force_n in (-2000, 2000, 0):
        bench.load_force(force_n)
        bench.run(0.2)
    bench.check_timing(LIMITS)


@pytest.mark.needs("wire_faults")
def test_a_violation_names_the_period_and_the_frames(bench):
    bench.run(0.05)
    bench.delay("PositionFeedback", 1.2 * PERIOD_S)
    bench.run(0.05)
    violation = r"period 50 \(0\.050 s\): feedback age .*PositionFeedback \(counter \d+\) ended at bus time"
    with pytest.raises(AssertionError, match=violation):
        bench.check_timing(LIMITS)


def test_the_observer_on_the_bus_is_the_controllers_own(bench):
    bench.setpoint(sine)
    bench.run(1.0)
    shown = bench.signal("ObserverState.EsoPosition").between(0.0)
    assert len(shown) >= 1.0 / (7 * 10 * PERIOD_S) - 1
    row = np.floor(shown.time_s / PERIOD_S).astype(int)
    assert np.array_equal(shown.values, bench.trace["eso_position_m"][row])
    assert np.abs(shown.values * 1e3 - bench.position_mm.values[row]).max() < 0.2


@pytest.mark.bench(position_m=0.1)
def test_the_status_reports_state_and_faults(bench):
    bench.silence("PositionSetpoint")
    bench.run(0.25)
    reported = {name: bench.signal(f"ControllerStatus.{name}").last for name in ("State", "SetpointLost")}
    assert reported == {"State": State.SAFE, "SetpointLost": 1}
    for name in ("FeedbackLost", "CommandLost", "DriveStatusLost", "DriveFault", "MailboxOverrun"):
        assert bench.signal(f"ControllerStatus.{name}").last == 0, name


def test_the_pressures_on_the_bus_are_the_plants(bench):
    bench.setpoint(sine)
    bench.run(1.0)
    for chamber, column in (("A", "pressure_a_bar"), ("B", "pressure_b_bar")):
        shown = bench.signal(f"PressureFeedback.Pressure{chamber}").between(0.0)
        row = np.floor(shown.time_s / PERIOD_S).astype(int)
        assert len(shown) == 100
        assert shown.values == pytest.approx(bench.trace[column][row], abs=0.0051)
        assert shown.values.min() > 2.0
        assert shown.max < 15.0
