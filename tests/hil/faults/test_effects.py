"""What each kind of fault is seen to do, in one process: a test for every kind there is.

The reference is the sine, and a fault begins 10 ms after the bench is ready. Frames are told apart by the
period in which they end; the nodes' records say what they did themselves.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dbc.e2e import Status
from dbc.frame import ERR_FLAG
from dbc.messages import BenchCommand, BenchFault, BenchParameter
from dbc.node import PERIOD_NS
from firmware_py.diagnosis import State
from hil.bench import Bench
from hil.faults.catalogue import GROUPS, KINDS, fault_of
from hil.references import sine
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions

FIRST = 10
"""Period in which the fault begins."""

Effect = Callable[[Bench], None]
EFFECTS: dict[str, Effect] = {}


def effect_of(kind: str) -> Callable[[Effect], Effect]:
    def register(effect: Effect) -> Effect:
        assert kind not in EFFECTS
        EFFECTS[kind] = effect
        return effect

    return register


class Unharmed(Bench):
    """A bench on which nothing goes wrong."""

    def inject(self, fault, **parameters) -> None:
        fault_of(fault, parameters)


@pytest.fixture(scope="module")
def rig() -> Iterator[InprocessRig]:
    with InprocessRig(RigOptions(record_directory=Path())) as rig:
        yield rig


def ready(bench: Bench) -> Bench:
    bench.setpoint(sine)
    return bench


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_is_seen_to_do_what_it_says(rig, kind):
    assert kind in EFFECTS, f"add a test of what {kind} does"
    EFFECTS[kind](ready(Bench(rig)))


@pytest.mark.parametrize("kind", KINDS)
def test_without_the_fault_it_is_not_seen(rig, kind):
    with pytest.raises(AssertionError):
        EFFECTS[kind](ready(Unharmed(rig)))


def test_no_effect_is_of_a_fault_that_is_gone():
    assert set(EFFECTS) == set(KINDS)


def harm(bench: Bench, kind: str, run_s: float = 0.04, **parameters) -> None:
    bench.inject(kind, at_s=FIRST * PERIOD_NS / 1e9, **parameters)
    bench.run(run_s)


def frames(bench: Bench, message: str) -> list[tuple[int, int]]:
    """Ends (ns since the bench was ready) and payloads of a message."""
    recording, can_id = bench.recording, bench.contract.message(message).can_id
    rows = [(time_ns, data) for time_ns, row_id, _, data in recording.traffic.tolist() if row_id == can_id]
    return [(time_ns - recording.start_ns, data) for time_ns, data in rows if time_ns >= recording.start_ns]


def periods(bench: Bench, message: str) -> list[int]:
    return [end_ns // PERIOD_NS for end_ns, _ in frames(bench, message)]


def counter(data: int) -> int:
    return data >> 8 & 0xF


def not_ok(bench: Bench, message: str) -> dict[int, Status]:
    """What a receiver finds wrong, by the period."""
    checker = bench.contract.message(message).checker()
    found = {
        end_ns // PERIOD_NS: status
        for end_ns, data in frames(bench, message)
        if (status := checker.check(data)) not in (Status.OK, Status.INITIAL)
    }
    return found


def sent_and_meant(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    """The setpoints on the bus, and those that the supervisor took from the reference; 0.1 µm."""
    unpack = bench.contract.position_setpoint.unpack
    sent = [unpack(data).position for _, data in frames(bench, "PositionSetpoint")]
    return np.array(sent), bench.recording.supervisor["setpoint_raw"][-len(sent) :]


def errors_at(bench: Bench) -> list[int]:
    """Periods with an error frame."""
    recording = bench.recording
    times = recording.traffic[recording.traffic[:, 1] & ERR_FLAG != 0][:, 0].astype(np.int64)
    return ((times - recording.start_ns) // PERIOD_NS).tolist()


# on the bus


@effect_of("drop")
def dropped(bench):
    harm(bench, "drop", message="PositionFeedback", count=2)
    assert periods(bench, "PositionFeedback") == [k for k in range(40) if k not in (FIRST, FIRST + 1)]


@effect_of("delay")
def delayed(bench):
    harm(bench, "delay", message="PositionFeedback", delay_s=0.0012)
    counters = [counter(data) for _, data in frames(bench, "PositionFeedback")]
    first = counters[FIRST - 1]
    overtaken = [(first + step) % 16 for step in (2, 1, 3)]
    assert counters[FIRST : FIRST + 3] == overtaken


@effect_of("duplicate")
def duplicated(bench):
    harm(bench, "duplicate", message="PositionFeedback")
    seen = frames(bench, "PositionFeedback")
    assert periods(bench, "PositionFeedback").count(FIRST) == 2
    assert seen[FIRST][1] == seen[FIRST + 1][1]
    assert len(seen) == 41


@effect_of("corrupt")
def corrupted(bench):
    harm(bench, "corrupt", message="PositionFeedback", bit=20, count=2)
    assert not_ok(bench, "PositionFeedback").keys() >= {FIRST, FIRST + 1}
    assert not_ok(bench, "PositionFeedback")[FIRST] == Status.WRONGCRC
    checker = bench.contract.position_feedback.checker()
    mended = [
        data ^ (1 << 20 if end_ns // PERIOD_NS in (FIRST, FIRST + 1) else 0)
        for end_ns, data in frames(bench, "PositionFeedback")
    ]
    assert {checker.check(data) for data in mended[1:]} <= {Status.OK, Status.INITIAL}


@effect_of("repeat")
def repeated(bench):
    harm(bench, "repeat", message="PositionFeedback", count=2)
    payloads = [data for _, data in frames(bench, "PositionFeedback")]
    assert payloads[FIRST - 1] == payloads[FIRST] == payloads[FIRST + 1]
    assert payloads[FIRST + 2] not in payloads[: FIRST + 2]


@effect_of("destroy")
def destroyed(bench):
    harm(bench, "destroy", message="DriveCommand", count=2)
    assert errors_at(bench) == [FIRST, FIRST]
    assert bench.error_state("controller").name == "error-active"


@effect_of("bit_errors")
def disturbed(bench):
    harm(bench, "bit_errors", rate=0.002, duration_s=0.01, seed=3)
    assert len(errors_at(bench)) > 3
    assert FIRST <= min(errors_at(bench)) <= max(errors_at(bench)) <= FIRST + 10


@effect_of("babble")
def babbled(bench):
    harm(bench, "babble", duration_s=0.01)
    traffic = bench.recording.traffic
    babble = traffic[traffic[:, 1] == 0][:, 0].astype(np.int64) - bench.recording.start_ns
    assert len(babble) > 70
    assert set(range(FIRST + 1, FIRST + 9)).isdisjoint(periods(bench, "DriveCommand"))
    assert FIRST + 12 in periods(bench, "DriveCommand")


@effect_of("bus_off")
def taken_off(bench):
    harm(bench, "bus_off", run_s=0.011, node="controller")
    assert bench.error_state("controller").name == "bus-off"
    bench.run(0.02)
    assert bench.error_state("controller").name == "error-active"
    silent = set(range(30)) - set(periods(bench, "DriveCommand"))
    assert FIRST in silent
    assert max(silent) < FIRST + 5


@effect_of("cut_off")
def cut_off(bench):
    harm(bench, "cut_off", node="controller", duration_s=0.01)
    silent = set(range(FIRST, FIRST + 10))
    assert set(periods(bench, "DriveCommand")) == set(range(40)) - silent
    assert np.isfinite(bench.trace["controller_state"]).all(), "it goes on"
    assert bench.controller_state == State.SAFE, "it heard nothing"
    counters = [counter(data) for _, data in frames(bench, "DriveCommand")]
    assert counters[FIRST] == (counters[FIRST - 1] + 11) % 16


@effect_of("power_off")
def powered_off(bench):
    harm(bench, "power_off", node="controller", duration_s=0.01)
    silent = set(range(FIRST, FIRST + 10))
    assert set(periods(bench, "DriveCommand")) == set(range(40)) - silent
    assert not np.isfinite(bench.trace["controller_state"][FIRST : FIRST + 10]).any()
    assert counter(frames(bench, "DriveCommand")[FIRST][1]) == 1, "it began anew"


# on a message


@effect_of("wrong_crc")
def wrong_crc(bench):
    harm(bench, "wrong_crc", message="DriveCommand", count=2)
    found = not_ok(bench, "DriveCommand")
    assert [period for period, status in found.items() if status == Status.WRONGCRC] == [FIRST, FIRST + 1]


@effect_of("frozen_counter")
def frozen_counter(bench):
    harm(bench, "frozen_counter", message="PositionFeedback", count=3)
    found = not_ok(bench, "PositionFeedback")
    repeated = [period for period, status in found.items() if status == Status.REPEATED]
    assert repeated == [FIRST, FIRST + 1, FIRST + 2]
    assert Status.WRONGCRC not in found.values()


@effect_of("jumping_counter")
def jumping_counter(bench):
    harm(bench, "jumping_counter", message="DriveStatus", jump=5, count=1, run_s=0.06)
    found = not_ok(bench, "DriveStatus")
    assert found.get(FIRST + 2) == Status.WRONGSEQUENCE, "DriveStatus comes 2 ms after every tenth period"
    assert Status.WRONGCRC not in found.values()
    counters = [counter(data) for _, data in frames(bench, "DriveStatus")]
    assert [(b - a) % 16 for a, b in pairwise(counters)] == [6, 12, 1, 1, 1]


@effect_of("frozen_signal")
def frozen_signal(bench):
    bench.run(0.1)
    harm(bench, "frozen_signal", message="PositionSetpoint", signal="Position", count=5)
    sent, meant = sent_and_meant(bench)
    first = 100 + FIRST
    assert set(sent[first : first + 5]) == {meant[first]}
    assert len(set(meant[first : first + 5])) == 5
    assert (np.delete(sent, range(first, first + 5)) == np.delete(meant, range(first, first + 5))).all()
    assert not_ok(bench, "PositionSetpoint") == {}


@effect_of("signal_offset")
def signal_offset(bench):
    harm(bench, "signal_offset", message="PositionSetpoint", signal="Position", offset=-0.0005, count=5)
    sent, meant = sent_and_meant(bench)
    assert np.flatnonzero(sent != meant).tolist() == list(range(FIRST, FIRST + 5))
    assert set(sent[FIRST : FIRST + 5] - meant[FIRST : FIRST + 5]) == {-5000}
    assert not_ok(bench, "PositionSetpoint") == {}


@effect_of("signal_ramp")
def signal_ramp(bench):
    harm(bench, "signal_ramp", message="PositionSetpoint", signal="Position", rate_per_s=0.2, count=5)
    sent, meant = sent_and_meant(bench)
    assert (sent - meant)[FIRST : FIRST + 6].tolist() == [0, 2000, 4000, 6000, 8000, 0], "200 µm each ms"
    assert not_ok(bench, "PositionSetpoint") == {}


@effect_of("random_signal")
def random_signal(bench):
    where = {"message": "PositionSetpoint", "signal": "Position"}
    harm(bench, "random_signal", low=0.1, high=0.2, count=8, seed=4, **where)
    sent, meant = sent_and_meant(bench)
    drawn = sent[FIRST : FIRST + 8]
    assert len(set(drawn)) == 8
    assert ((drawn >= 1_000_000) & (drawn <= 2_000_000)).all()
    assert np.flatnonzero(sent != meant).tolist() == list(range(FIRST, FIRST + 8))
    assert not_ok(bench, "PositionSetpoint") == {}


# of sensor and machine: the plant is told, also when it is over, and does not go on as it would have;
# tests/plant_sim says how


@pytest.mark.parametrize("kind", [kind.kind for group in ("sensor", "machine") for kind in GROUPS[group]])
def test_what_the_plant_is_told_makes_a_difference_from_then_on(rig, kind):
    harmed, unharmed = ready(Bench(rig)), ready(Bench(rig))
    for bench in (harmed, unharmed):
        bench.run(0.5)
    harmed.inject(kind, at_s=0.01, **STRONG.get(kind, {}))
    for bench in (harmed, unharmed):
        bench.run(0.1)
    rows = zip(shown_by(harmed), shown_by(unharmed), strict=True)
    differs = np.array([not np.array_equal(*pair, equal_nan=True) for pair in rows])
    assert 510 <= np.argmax(differs) <= 520
    assert differs.sum() > 50


STRONG = {
    "sensor_bias": {"bias_m": 0.001},
    "sensor_drift": {"drift_m_s": 0.01},
    "sensor_noise": {"rms_m": 1e-5},
    "sensor_status": {"status": 1},
    "precharge_loss": {"factor": 0.5},
    "leak": {"factor": 3.0},
    "efficiency_loss": {"factor": 0.5},
    "entrained_air": {"factor": 0.1},
    "motor_speed_loss": {"factor": 0.05},
    "motor_acceleration_loss": {"factor": 0.01},
    "load_step": {"force_n": -500.0},
    "load_impulse": {"impulse_n_s": 5.0},
}


def shown_by(bench: Bench) -> np.ndarray:
    """Position and pressures of the machine, and the PositionFeedback of the period, NaN without one."""
    feedback = np.full(len(bench.trace["time_s"]), np.nan)
    for end_ns, data in frames(bench, "PositionFeedback"):
        feedback[end_ns // PERIOD_NS] = data >> 8
    names = ("position_m", "pressure_a_bar", "pressure_b_bar")
    return np.column_stack([feedback, *(bench.trace[name] for name in names)])


def told(bench: Bench) -> list[tuple[int, int, int, int]]:
    """Period, command, identifier and value of each BenchControl."""
    unpack = bench.contract.bench_control.unpack
    return [(end_ns // PERIOD_NS, *unpack(data)) for end_ns, data in frames(bench, "BenchControl")]


def sensor_effect(kind: str, fault: BenchFault, value: int, **parameters: float) -> None:
    @effect_of(kind)
    def is_told(bench: Bench) -> None:
        harm(bench, kind, duration_s=0.005, **parameters)
        command = BenchCommand.SET_FAULT
        assert told(bench) == [(FIRST, command, fault, value), (FIRST + 5, command, fault, 0)]


sensor_effect("sensor_stuck", BenchFault.SENSOR_STUCK, 1_000_000)
sensor_effect("sensor_bias", BenchFault.SENSOR_BIAS, -1500, bias_m=-0.0015)
sensor_effect("sensor_drift", BenchFault.SENSOR_DRIFT, 2000, drift_m_s=0.002)
sensor_effect("sensor_noise", BenchFault.SENSOR_NOISE, 20, rms_m=20e-6)
sensor_effect("sensor_dropout", BenchFault.SENSOR_DROPOUT, 1_000_000)
sensor_effect("sensor_status", BenchFault.SENSOR_STATUS, 3_000_000, status=3)


def machine_effect(kind: str, parameter: BenchParameter, value: int, **parameters: float) -> None:
    @effect_of(kind)
    def is_told(bench: Bench) -> None:
        harm(bench, kind, duration_s=0.005, **parameters)
        command = BenchCommand.SCALE_PARAMETER
        assert told(bench) == [
            (FIRST, command, parameter, value),
            (FIRST + 5, command, parameter, 1_000_000),
        ]


machine_effect("precharge_loss", BenchParameter.PRECHARGE, 500_000, factor=0.5)
machine_effect("leak", BenchParameter.LEAK, 5_000_000, factor=5.0)
machine_effect("relief_stuck_open", BenchParameter.RELIEF_CRACK, 0)
machine_effect("efficiency_loss", BenchParameter.EFFICIENCY, 700_000, factor=0.7)
machine_effect("entrained_air", BenchParameter.BULK_MODULUS, 200_000, factor=0.2)
machine_effect("motor_speed_loss", BenchParameter.MOTOR_SPEED, 100_000, factor=0.1)
machine_effect("motor_acceleration_loss", BenchParameter.MOTOR_ACCELERATION, 250_000, factor=0.25)


@effect_of("load_step")
def load_step(bench):
    bench.load_force(300)
    harm(bench, "load_step", force_n=-2000.0, duration_s=0.02)
    load_n = bench.trace["load_n"]
    assert (load_n[:FIRST] == 300.0).all()
    assert (load_n[FIRST : FIRST + 20] == -1700.0).all()
    assert (load_n[FIRST + 20 :] == 300.0).all()


@effect_of("load_impulse")
def load_impulse(bench):
    harm(bench, "load_impulse", impulse_n_s=30.0, duration_s=0.004)
    load_n = bench.trace["load_n"]
    assert np.flatnonzero(load_n).tolist() == list(range(FIRST, FIRST + 4))
    assert load_n.sum() * 1e-3 == pytest.approx(30.0)


# of a node's own running


@effect_of("reset")
def reset(bench):
    harm(bench, "reset")
    counters = [counter(data) for _, data in frames(bench, "DriveCommand")]
    assert counters[FIRST : FIRST + 3] == [1, 2, 3]
    assert bench.controller_state == State.STANDBY


def command_delay_us(bench: Bench) -> np.ndarray:
    """How much later than the first one each DriveCommand ends in its period, µs, but for stuff bits."""
    ends_ns = np.array([end_ns for end_ns, _ in frames(bench, "DriveCommand")])
    return (ends_ns - ends_ns[0] - np.arange(len(ends_ns)) * PERIOD_NS) / 1e3


STUFFING_US = 12.0


@effect_of("clock_drift")
def clock_drift(bench):
    harm(bench, "clock_drift", drift_ppm=-5000.0, duration_s=0.02)
    delay_us = command_delay_us(bench)
    assert np.abs(delay_us[:FIRST]).max() < STUFFING_US
    assert delay_us[FIRST + 10] == pytest.approx(50.0, abs=STUFFING_US), "5 µs each ms"
    assert delay_us[-1] == pytest.approx(100.0, abs=STUFFING_US), "and stays behind"


@effect_of("late_period")
def late_period(bench):
    harm(bench, "late_period", late_us=300.0, count=2)
    delay_us = command_delay_us(bench)
    assert delay_us[FIRST : FIRST + 2] == pytest.approx(300.0, abs=STUFFING_US)
    assert np.abs(np.delete(delay_us, [FIRST, FIRST + 1])).max() < STUFFING_US
    called_ns = bench.recording.controller["time_ns"][-40:] % PERIOD_NS
    assert called_ns[FIRST - 1 : FIRST + 3].tolist() == [0, 300_000, 300_000, 0]


@effect_of("long_execution")
def long_execution(bench):
    harm(bench, "long_execution", extra_us=300.0, count=2)
    delay_us = command_delay_us(bench)
    assert delay_us[FIRST : FIRST + 2] == pytest.approx(300.0, abs=STUFFING_US)
    assert np.abs(np.delete(delay_us, [FIRST, FIRST + 1])).max() < STUFFING_US
    assert (bench.recording.controller["time_ns"] % PERIOD_NS == 0).all(), "its timer is not late"
