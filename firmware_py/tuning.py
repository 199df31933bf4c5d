"""Host side: physical gains (SI floats) to a calibration block. Never imported by the node or the kernel."""

import math
from dataclasses import dataclass, field

from firmware_py.calibration import VALUE_RANGES, WORD_NAMES, Calibration
from firmware_py.calibration_block import MAX_SHIFT, MIN_SHIFT
from firmware_py.kernel import layout as k
from firmware_py.kernel.fal import log2_q22
from firmware_py.kernel.fixedpoint import INT32_MAX

PERIOD_S = 1e-3

POSITION_LSB = 2.0**-31  # m: v1, z1 and every position error
SPEED_LSB = 2.0**-38  # m: v2 T, z2 T
ACCELERATION_LSB = 2.0**-40  # m: v3 T^2, z3 T^2
DISTURBANCE_LSB = 2.0**-42  # m: z4 T^3
WORK_LSB = 2.0**-34  # m: inside fhan
U_LSB = 2.0**-20  # rad/s
SETPOINT_LSB_M = 1e-7
VELOCITY_LSB_RAD_S = math.pi / 120  # 0.25 rpm

RELATIVE_PRECISION = 1e-6
"""A gain whose mantissa cannot come this close to it is refused."""


class TuningError(ValueError):
    """A physical gain that the kernel's number formats cannot represent."""


@dataclass(frozen=True, slots=True)
class PiTuning:
    """Proportional and integral gain; `ki_rad_s2_per_m` = 0 makes a P controller."""

    kp_rad_s_per_m: float
    ki_rad_s2_per_m: float = 0.0


@dataclass(frozen=True, slots=True)
class AdrcTuning:
    """ADRC with bandwidth gains; the defaults are the ones the paper's design was completed with.

    The exponents of fal are part of the kernel (1/4 and 1/8 in the observer, 3/4 in the feedback): shifts of
    a logarithm make them. A very wide linear zone makes a linear controller.
    """

    r0_m_s2: float = 25.0
    h0_s: float = 5e-3
    omega_o_rad_s: float = 200.0
    b0_m_s2_per_rad: float = 70.0
    a1n_per_s2: float = -5e4
    a2n_per_s: float = 0.0
    omega_c_rad_s: float = 180.0
    eso_delta_m: float = 1e-4
    delta1_m: float = 1e-3
    delta2_m_s: float = 0.04
    delta3_m_s2: float = 3.0


@dataclass(frozen=True, slots=True)
class FrontEndTuning:
    """Velocity feed-forward on the limited setpoint.

    Attributes
    ----------
    extend_rad_per_m, retract_rad_per_m : float
        Motor speed per rod speed. Lossless, it is A_A / D_A = 1363 rad/m (Table 2); the pumps' loss makes it
        A_A / (eta D_A) = 1604 to extend and A_A / ((2 - eta) D_A) = 1186 to retract under a load that pushes
        the rod in. What lies between serves loads of both directions.
    lead_s : float
        Time by which the setpoint's speed is led, for what filter, bus and motor take: s.
    lead_filter_s : float
        Time constant of the low-pass behind which its acceleration is taken, s.
    """

    extend_rad_per_m: float = 1600.0
    retract_rad_per_m: float = 1350.0
    lead_s: float = 6e-3
    lead_filter_s: float = 15e-3


@dataclass(frozen=True, slots=True)
class CommandFilterTuning:
    """Low-pass and slew limit on the way to the drive; a time constant of 0 makes no low-pass."""

    time_constant_s: float = 0.67e-3
    slew_rad_s2: float = 2000.0


@dataclass(frozen=True, slots=True)
class ScheduledTuning:
    """ADRC whose nominal model is scheduled on the position; every gain is fitted over the box of machines.

    The oil's stiffness over that at the reference position is
    S(x) = (1 / (x + end_a) + weight / (L - x + end_b)) / (the same at the reference): the form of eqs 20 to
    22, whose weight is the areas' ratio 0.75 and whose ends are 0.7 and 0.9 mm. The weight is less, because
    where a controller holds the load the rod side's check valve conducts, and its oil is no spring.
    b0(x) = b0 S(x) and a1n(x) = -kappa b0(x) with the front end's kappa.

    Attributes
    ----------
    b0_m_s2_per_rad : float
        Input gain at the reference position; far below the machine's, as for soft oil and a heavy load.
    beta1_per_s, beta2_per_s2, beta3_per_s3 : float
        Observer gains of eq. 26.
    omega_d_rad_s : float
        Bandwidth of the disturbance, about the slowest pole of the observer:
        beta04 = omega_d (beta03 + \\|a1n(x)\\| beta01).
    k1_rad_s_per_m, k2_rad_per_m : float
        Motor speed per error of position and of velocity.
    k3_rad_s2_per_m, k3_soft_rad_s2_per_m : float
        Motor speed taken back per acceleration (rad/s per m/s²), constant and in proportion to 1 / S.
    motor_time_constant_s : float
        Of the motor in the observer's model.
    """

    b0_m_s2_per_rad: float = 2.277
    beta1_per_s: float = 503.7
    beta2_per_s2: float = 118_700.0
    beta3_per_s3: float = 440_600.0
    omega_d_rad_s: float = 12.04
    k1_rad_s_per_m: float = 6000.0
    k2_rad_per_m: float = -17.39
    k3_rad_s2_per_m: float = 0.3702
    k3_soft_rad_s2_per_m: float = 1.714
    motor_time_constant_s: float = 0.39e-3
    stroke_m: float = 0.4
    end_a_m: float = 0.04495
    end_b_m: float = 0.1833
    rod_side_weight: float = 0.1949
    reference_m: float = 0.15

    def stiffness(self, position_m: float) -> float:
        """Return S(x)."""
        return self._columns(min(max(position_m, 0.0), self.stroke_m)) / self._columns(self.reference_m)

    @property
    def reference_columns_m(self) -> float:
        """Length of one column of A as stiff as both are at the reference."""
        return 1 / self._columns(self.reference_m)

    def _columns(self, position_m: float) -> float:
        column_b_m = self.stroke_m - position_m + self.end_b_m
        return 1 / (position_m + self.end_a_m) + self.rod_side_weight / column_b_m


@dataclass(frozen=True, slots=True)
class LimiterTuning:
    """Velocity and acceleration a setpoint may ask for."""

    speed_m_s: float = 0.14
    acceleration_m_s2: float = 1.0


P = PiTuning(31_100.0)
PI = PiTuning(27_270.0, 39_900.0)
PI_FF = PiTuning(16_128.0, 139_400.0)
PI_STAR = PiTuning(20_853.0, 513_300.0)
ADRC = AdrcTuning()
LINEAR = AdrcTuning(  # bandwidths optimised under Ms <= 2, see hil.study.rivals
    omega_o_rad_s=201.0,
    omega_c_rad_s=215.0,
    eso_delta_m=0.99,
    delta1_m=0.99,
    delta2_m_s=7.8,
    delta3_m_s2=1950.0,
)
"""ADRC in a linear zone so wide that it never leaves it."""


def _gain(index: int, factor: float) -> dict[int, int]:
    """Mantissa and shift of `factor`: the largest shift whose mantissa fits 31 bits."""
    name = WORD_NAMES[index]
    if factor == 0:
        return {index: 0, index + 1: MIN_SHIFT}
    if not math.isfinite(factor):
        raise TuningError(f"tuning: {name} = {factor} is not finite")
    shift = min(MAX_SHIFT, 31 - math.frexp(factor)[1])
    if abs(round(math.ldexp(factor, shift))) > INT32_MAX:
        shift -= 1
    mantissa = round(math.ldexp(factor, shift))
    if shift < MIN_SHIFT:
        raise TuningError(f"tuning: {name} = {factor:.6g} exceeds {INT32_MAX * 2.0**-MIN_SHIFT:.6g}")
    if abs(math.ldexp(mantissa, -shift) - factor) > RELATIVE_PRECISION * abs(factor):
        raise TuningError(f"tuning: {name} = {factor:.6g} is too small for 31 bits at shift {MAX_SHIFT}")
    return {index: mantissa, index + 1: shift}


def _value(index: int, physical: float, lsb: float) -> dict[int, int]:
    name = WORD_NAMES[index]
    low, high = VALUE_RANGES[index]
    if not low * lsb <= physical <= high * lsb:
        raise TuningError(f"tuning: {name} = {physical:.6g} outside {low * lsb:.6g}..{high * lsb:.6g}")
    return {index: round(physical / lsb)}


def _zone(index: int, physical: float, lsb: float) -> dict[int, int]:
    half_width = _value(index, physical, lsb)
    return half_width | {index + 1: log2_q22(half_width[index])}


@dataclass(frozen=True, slots=True)
class Tuning:
    """Everything a calibration block holds.

    Parameters
    ----------
    law : int
        Default control law.
    speed_limit_rpm : float
        The drive's speed; rounded down to 0.25 rpm.
    """

    law: int = k.LAW_ADRC
    p: PiTuning = P
    pi: PiTuning = PI
    adrc: AdrcTuning = field(default_factory=AdrcTuning)
    scheduled: ScheduledTuning = field(default_factory=ScheduledTuning)
    front_end: FrontEndTuning = field(default_factory=FrontEndTuning)
    command_filter: CommandFilterTuning = field(default_factory=CommandFilterTuning)
    limiter: LimiterTuning = field(default_factory=LimiterTuning)
    speed_limit_rpm: float = 3000.0

    def calibration(self) -> Calibration:
        """Return the calibration block.

        Raises
        ------
        TuningError
            When a gain cannot be represented; the message is one line.
        """
        if self.p.ki_rad_s2_per_m != 0:
            raise TuningError("tuning: the P law has no integral gain")
        words = self._limits() | self._pi() | _differentiator(self.adrc) | _observer(self.adrc)
        words |= _feedback(self.adrc)
        words |= _front_end(self.front_end) | _command_filter(self.command_filter)
        words |= _schedule(self.scheduled) | _scheduled_observer(self.scheduled, self.front_end)
        words |= _scheduled_feedback(self.scheduled)
        return Calibration(self.law, tuple(words[index] for index in range(k.CAL_SIZE)))

    def _limits(self) -> dict[int, int]:
        limit_rad_s = math.floor(self.speed_limit_rpm * 4) * VELOCITY_LSB_RAD_S
        rate_m = self.limiter.speed_m_s * PERIOD_S
        slew_m = self.limiter.acceleration_m_s2 * PERIOD_S**2
        # rounding the setpoint to its LSB adds up to 1 LSB to its increments and 2 to their differences,
        # rounding it to the kernel's LSB as much again
        rounding_m = SETPOINT_LSB_M + 1.5 * POSITION_LSB
        return (
            _value(k.CAL_U_LIMIT, limit_rad_s, U_LSB)
            | _value(k.CAL_LIMITER_RATE, rate_m + rounding_m, POSITION_LSB)
            | _value(k.CAL_LIMITER_SLEW, slew_m + 2 * rounding_m, POSITION_LSB)
            | _value(k.CAL_LIMITER_BRAKE, slew_m, POSITION_LSB)
        )

    def _pi(self) -> dict[int, int]:
        lsb = POSITION_LSB / U_LSB
        return (
            _gain(k.CAL_P_KP, self.p.kp_rad_s_per_m * lsb)
            | _gain(k.CAL_PI_KP, self.pi.kp_rad_s_per_m * lsb)
            | _gain(k.CAL_PI_KI, self.pi.ki_rad_s2_per_m * PERIOD_S * lsb)
        )


def _differentiator(adrc: AdrcTuning) -> dict[int, int]:
    periods = adrc.h0_s / PERIOD_S
    return (
        _value(k.CAL_TD_D, adrc.r0_m_s2 * adrc.h0_s**2, WORK_LSB)
        | _gain(k.CAL_TD_K, WORK_LSB / ACCELERATION_LSB / periods**2)
        | _gain(k.CAL_TD_H, periods * SPEED_LSB / WORK_LSB)
        | _gain(k.CAL_LEAD_V1, 2 * periods * SPEED_LSB / POSITION_LSB)
        | _gain(k.CAL_LEAD_V2, 2 * periods * ACCELERATION_LSB / SPEED_LSB)
    )


def _observer(adrc: AdrcTuning) -> dict[int, int]:
    w = adrc.omega_o_rad_s * PERIOD_S
    return (
        _zone(k.CAL_ESO_DELTA, adrc.eso_delta_m, POSITION_LSB)
        | _gain(k.CAL_ESO_BETA1, 4 * w)
        | _gain(k.CAL_ESO_BETA2, 6 * w**2 * POSITION_LSB / SPEED_LSB)
        | _gain(k.CAL_ESO_BETA3, 4 * w**3 * POSITION_LSB / ACCELERATION_LSB)
        | _gain(k.CAL_ESO_BETA4, w**4 * POSITION_LSB / DISTURBANCE_LSB)
        | _gain(k.CAL_ESO_A1, adrc.a1n_per_s2 * PERIOD_S**2 * SPEED_LSB / ACCELERATION_LSB)
        | _gain(k.CAL_ESO_A2, adrc.a2n_per_s * PERIOD_S)
        | _gain(k.CAL_ESO_B0, adrc.b0_m_s2_per_rad * PERIOD_S**3 * U_LSB / ACCELERATION_LSB)
    )


def _feedback(adrc: AdrcTuning) -> dict[int, int]:
    if not adrc.b0_m_s2_per_rad > 0:
        raise TuningError(f"tuning: b0 = {adrc.b0_m_s2_per_rad} must be positive")
    per_b0 = 1 / (adrc.b0_m_s2_per_rad * U_LSB)
    w = adrc.omega_c_rad_s
    position = per_b0 * POSITION_LSB
    speed = per_b0 * SPEED_LSB / PERIOD_S
    acceleration = per_b0 * ACCELERATION_LSB / PERIOD_S**2
    return (
        _zone(k.CAL_FB_DELTA1, adrc.delta1_m, POSITION_LSB)
        | _zone(k.CAL_FB_DELTA2, adrc.delta2_m_s * PERIOD_S, SPEED_LSB)
        | _zone(k.CAL_FB_DELTA3, adrc.delta3_m_s2 * PERIOD_S**2, ACCELERATION_LSB)
        | _gain(k.CAL_FB_K1, w**3 * position)
        | _gain(k.CAL_FB_K2, 3 * w**2 * speed)
        | _gain(k.CAL_FB_K3, 3 * w * acceleration)
        | _gain(k.CAL_FB_A1, adrc.a1n_per_s2 * speed)
        | _gain(k.CAL_FB_A2, adrc.a2n_per_s * acceleration)
        | _gain(k.CAL_FB_Z4, per_b0 * DISTURBANCE_LSB / PERIOD_S**3)
    )


def _share(time_constant_s: float) -> float:
    """Return the share of a step that a first-order lag passes in a period."""
    return -math.expm1(-PERIOD_S / time_constant_s) if time_constant_s > 0 else 1.0


def _front_end(front_end: FrontEndTuning) -> dict[int, int]:
    lsb = SPEED_LSB / PERIOD_S / U_LSB
    smooth = _share(front_end.lead_filter_s)
    return (
        _gain(k.CAL_FRONT_SMOOTH, smooth * SPEED_LSB / ACCELERATION_LSB)
        | _gain(k.CAL_FRONT_LEAD, front_end.lead_s / PERIOD_S * ACCELERATION_LSB / SPEED_LSB)
        | _gain(k.CAL_FRONT_EXTEND, front_end.extend_rad_per_m * lsb)
        | _gain(k.CAL_FRONT_RETRACT, front_end.retract_rad_per_m * lsb)
    )


def _command_filter(command_filter: CommandFilterTuning) -> dict[int, int]:
    return _gain(k.CAL_COMMAND_SMOOTH, _share(command_filter.time_constant_s)) | _value(
        k.CAL_COMMAND_SLEW, command_filter.slew_rad_s2 * PERIOD_S, U_LSB
    )


def _schedule(scheduled: ScheduledTuning) -> dict[int, int]:
    share_m = scheduled.reference_columns_m
    return (
        _value(k.CAL_STROKE, scheduled.stroke_m, POSITION_LSB)
        | _value(k.CAL_STIFFNESS_END_A, scheduled.end_a_m, POSITION_LSB)
        | _value(k.CAL_STIFFNESS_END_B, scheduled.end_b_m, POSITION_LSB)
        | _value(k.CAL_STIFFNESS_A, share_m, POSITION_LSB)
        | _value(k.CAL_STIFFNESS_B, scheduled.rod_side_weight * share_m, POSITION_LSB)
    )


def _scheduled_observer(scheduled: ScheduledTuning, front_end: FrontEndTuning) -> dict[int, int]:
    if not scheduled.b0_m_s2_per_rad > 0:
        raise TuningError(f"tuning: b0 = {scheduled.b0_m_s2_per_rad} must be positive")
    kappa = (front_end.extend_rad_per_m + front_end.retract_rad_per_m) / 2
    disturbance = scheduled.omega_d_rad_s * PERIOD_S * POSITION_LSB / U_LSB
    soft = scheduled.beta3_per_s3 / scheduled.b0_m_s2_per_rad
    return (
        _gain(k.CAL_SCHEDULED_BETA1, scheduled.beta1_per_s * PERIOD_S)
        | _gain(k.CAL_SCHEDULED_BETA2, scheduled.beta2_per_s2 * PERIOD_S**2 * POSITION_LSB / SPEED_LSB)
        | _gain(k.CAL_SCHEDULED_BETA3, scheduled.beta3_per_s3 * PERIOD_S**3 * POSITION_LSB / ACCELERATION_LSB)
        | _gain(k.CAL_SCHEDULED_BETA4, disturbance * kappa * scheduled.beta1_per_s)
        | _gain(k.CAL_SCHEDULED_BETA4_SOFT, disturbance * soft)
        | _gain(k.CAL_SCHEDULED_B0, scheduled.b0_m_s2_per_rad * PERIOD_S**3 * U_LSB / ACCELERATION_LSB)
        | _gain(k.CAL_SCHEDULED_MOTOR, _share(scheduled.motor_time_constant_s))
    )


def _scheduled_feedback(scheduled: ScheduledTuning) -> dict[int, int]:
    acceleration = ACCELERATION_LSB / PERIOD_S**2 / U_LSB
    return (
        _gain(k.CAL_SCHEDULED_K1, scheduled.k1_rad_s_per_m * POSITION_LSB / U_LSB)
        | _gain(k.CAL_SCHEDULED_K2, scheduled.k2_rad_per_m * SPEED_LSB / PERIOD_S / U_LSB)
        | _gain(k.CAL_SCHEDULED_K3, scheduled.k3_rad_s2_per_m * acceleration)
        | _gain(k.CAL_SCHEDULED_K3_SOFT, scheduled.k3_soft_rad_s2_per_m * acceleration)
    )


TUNINGS = {
    "paper": Tuning(),
    "robust": Tuning(law=k.LAW_SCHEDULED),
    "pi_star": Tuning(law=k.LAW_PI, pi=PI_STAR),
    "pi_ff": Tuning(
        law=k.LAW_PI_FF,
        pi=PI_FF,
        front_end=FrontEndTuning(1367.0, 1367.0, lead_s=0.0),
        command_filter=CommandFilterTuning(0.96e-3, 1e5),
    ),
    "linear": Tuning(adrc=LINEAR),
}
"""The built-in calibrations by name; each has the law it is named for as its default.

pi_ff is the rival with plain velocity feed-forward, its gains made to hold over the box.
"""
