"""Faults of sensor and machine, and loads: they go over the bench channel, in real time as well."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from dbc.messages import BenchCommand, BenchFault, BenchParameter
from dbc.node import PERIOD_NS, next_period
from hil.faults.fault import Fault, FaultError, Stage, number, whole_ns
from plant_sim.parameters import MAX_LOAD_N

_MICRO = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchChannelFault(Fault):
    """One that the supervisor brings about with a frame to the plant, and ends with another.

    Parameters
    ----------
    duration_s : float
        How long it lasts, s; to the end of the run if not given.
    """

    needs_virtual_time: ClassVar[bool] = False

    duration_s: float = number(1e-3, math.inf, "s", default=math.inf)

    def inject(self, stage: Stage, origin_ns: int) -> None:
        """Have it begin with the first period `at_s` after time `origin_ns`, and end."""
        begin, end = self.words
        begin_ns = self.begin_ns(origin_ns)
        stage.supervisor.plan(next_period(begin_ns) // PERIOD_NS, **begin)
        if self.duration_s < math.inf:
            end_ns = begin_ns + whole_ns(self.duration_s)
            stage.supervisor.plan(next_period(end_ns) // PERIOD_NS, **end)

    @property
    @abstractmethod
    def words(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What `hil.supervisor.Supervisor.plan` is told when it begins, and when it ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFault(BenchChannelFault):
    """One of the position sensor."""

    fault: ClassVar[BenchFault]

    @property
    def words(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """On with the magnitude, off with zero."""
        on, off = ((BenchCommand.SET_FAULT, self.fault, round(v * _MICRO)) for v in (self.magnitude, 0.0))
        return {"control": on}, {"control": off}

    @property
    def magnitude(self) -> float:
        """Magnitude, SI."""
        return 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorStuck(SensorFault):
    """The position sensor stays at what it measures, and keeps sending it."""

    kind: ClassVar[str] = "sensor_stuck"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_STUCK


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDropout(SensorFault):
    """The position sensor sends nothing."""

    kind: ClassVar[str] = "sensor_dropout"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_DROPOUT


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorBias(SensorFault):
    """The position sensor is off by a constant."""

    kind: ClassVar[str] = "sensor_bias"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_BIAS

    bias_m: float = number(-1.0, 1.0, "m")

    @property
    def magnitude(self) -> float:
        """The bias, m."""
        return self.bias_m


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDrift(SensorFault):
    """The position sensor is off by more and more."""

    kind: ClassVar[str] = "sensor_drift"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_DRIFT

    drift_m_s: float = number(-1.0, 1.0, "m/s")

    @property
    def magnitude(self) -> float:
        """The drift, m/s."""
        return self.drift_m_s


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise(SensorFault):
    """The position sensor is noisy: white, normally distributed."""

    kind: ClassVar[str] = "sensor_noise"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_NOISE

    rms_m: float = number(0.0, 0.1, "m")

    @property
    def magnitude(self) -> float:
        """RMS, m."""
        return self.rms_m


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorStatus(SensorFault):
    """The position sensor reports a status of its own: 0 and 1 are usable, others are not."""

    kind: ClassVar[str] = "sensor_status"
    fault: ClassVar[BenchFault] = BenchFault.SENSOR_STATUS

    status: int = number(0, 15, "")

    @property
    def magnitude(self) -> float:
        """The raw status."""
        return float(self.status)


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterFault(BenchChannelFault):
    """One of the machine: a parameter becomes a multiple of its nominal value."""

    parameter: ClassVar[BenchParameter]

    @property
    def words(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The factor, and one."""
        begin, end = (
            (BenchCommand.SCALE_PARAMETER, self.parameter, round(v * _MICRO)) for v in (self.scale, 1.0)
        )
        return {"control": begin}, {"control": end}

    @property
    @abstractmethod
    def scale(self) -> float:
        """Factor on the nominal value."""


def _factor(low: float, high: float) -> Any:
    return number(low, high, "times nominal")


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss(ParameterFault):
    """One with a factor of its own."""

    factor: float = _factor(0.0, 1.0)

    @property
    def scale(self) -> float:
        """The factor."""
        return self.factor


@dataclass(frozen=True, slots=True, kw_only=True)
class PrechargeLoss(Loss):
    """The accumulators have lost gas."""

    kind: ClassVar[str] = "precharge_loss"
    parameter: ClassVar[BenchParameter] = BenchParameter.PRECHARGE

    factor: float = _factor(0.1, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Leak(Loss):
    """The pumps leak more."""

    kind: ClassVar[str] = "leak"
    parameter: ClassVar[BenchParameter] = BenchParameter.LEAK

    factor: float = _factor(1.0, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReliefStuckOpen(ParameterFault):
    """The relief valves are stuck open."""

    kind: ClassVar[str] = "relief_stuck_open"
    parameter: ClassVar[BenchParameter] = BenchParameter.RELIEF_CRACK

    @property
    def scale(self) -> float:
        """No cracking pressure at all."""
        return 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EfficiencyLoss(Loss):
    """The pumps deliver less."""

    kind: ClassVar[str] = "efficiency_loss"
    parameter: ClassVar[BenchParameter] = BenchParameter.EFFICIENCY

    factor: float = _factor(0.1, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class EntrainedAir(Loss):
    """Air in the oil makes it less stiff: its bulk modulus falls."""

    kind: ClassVar[str] = "entrained_air"
    parameter: ClassVar[BenchParameter] = BenchParameter.BULK_MODULUS

    factor: float = _factor(0.05, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorSpeedLoss(Loss):
    """The motor's largest speed falls."""

    kind: ClassVar[str] = "motor_speed_loss"
    parameter: ClassVar[BenchParameter] = BenchParameter.MOTOR_SPEED

    factor: float = _factor(0.01, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorAccelerationLoss(Loss):
    """The motor's largest acceleration falls."""

    kind: ClassVar[str] = "motor_acceleration_loss"
    parameter: ClassVar[BenchParameter] = BenchParameter.MOTOR_ACCELERATION

    factor: float = _factor(0.01, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadStep(BenchChannelFault):
    """A force on the rod comes on top of the others; positive resists extension."""

    kind: ClassVar[str] = "load_step"

    force_n: float = number(-MAX_LOAD_N, MAX_LOAD_N, "N")

    @property
    def words(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Add it, and take it away."""
        force_n = round(self.force_n)
        return {"add_load_n": force_n}, {"add_load_n": -force_n}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadImpulse(BenchChannelFault):
    """The rod is hit: an impulse, spread evenly over a short time."""

    kind: ClassVar[str] = "load_impulse"

    impulse_n_s: float = number(-1e4, 1e4, "N·s")
    duration_s: float = number(1e-3, 0.1, "s", default=0.01)

    def __post_init__(self) -> None:
        Fault.__post_init__(self)
        if abs(self.force_n) > MAX_LOAD_N:
            raise FaultError(
                f"load_impulse: impulse_n_s is {self.impulse_n_s}, must be within "
                f"{MAX_LOAD_N * self.duration_s:g} N·s over {self.duration_s:g} s",
                "impulse_n_s",
            )

    @property
    def force_n(self) -> int:
        """The force while it lasts, in whole N."""
        return round(self.impulse_n_s / self.duration_s)

    @property
    def words(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Add the force, and take it away."""
        return {"add_load_n": self.force_n}, {"add_load_n": -self.force_n}
