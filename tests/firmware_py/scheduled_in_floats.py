"""Laws 4 and 5 in plain SI floats, written from their equations, with an own setpoint limiter."""

import math

PERIOD_S = 1e-3
RAD_S_PER_COUNT = math.pi / 120


def clip(value, limit):
    return min(max(value, -limit), limit)


class FloatLimiter:
    """Velocity and slew limits relative to the moving setpoint; in steps of a period."""

    def __init__(self, tuning, position_m):
        self.rate_m = tuning.speed_m_s * PERIOD_S + 1.1e-7  # what rounding to 0.1 um may add
        self.brake_m = tuning.acceleration_m_s2 * PERIOD_S**2
        self.slew_m = self.brake_m + 2.2e-7
        self.input = self.position = position_m
        self.rate = 0.0

    def step(self, setpoint_m):
        motion = setpoint_m - self.input
        if abs(motion) > self.rate_m:
            motion = 0.0
        gap = setpoint_m - motion - self.position
        approach = gap
        if abs(gap) > self.brake_m:
            approach = math.copysign(
                (math.sqrt(self.brake_m * (self.brake_m + 8 * abs(gap))) - self.brake_m) / 2, gap
            )
        self.rate += clip(clip(motion + approach, self.rate_m) - self.rate, self.slew_m)
        self.position += self.rate
        self.input = setpoint_m
        return self.position, self.rate / PERIOD_S


def share(time_constant_s):
    return 1 - math.exp(-PERIOD_S / time_constant_s) if time_constant_s else 1.0


class FloatLaw:
    """What both laws have: front end and command filter; the command is clipped and quantised as on the bus.

    Parameters
    ----------
    tuning : Tuning
    position_um : int
        Where it starts, at rest.
    """

    def __init__(self, tuning, position_um):
        self.tuning = tuning
        self.limiter = FloatLimiter(tuning.limiter, position_um * 1e-6)
        self.smooth_m_s = 0.0
        self.command = 0.0
        self.sent = 0.0

    def step(self, setpoint, position_um):
        """Setpoint in 0.1 um, position in um -> target velocity in 0.25 rpm."""
        r, v = self.limiter.step(setpoint * 1e-7)
        front = self.tuning.front_end
        acceleration = (v - self.smooth_m_s) * share(front.lead_filter_s) / PERIOD_S
        self.smooth_m_s += acceleration * PERIOD_S
        feed_forward = self.speed_for(v + front.lead_s * acceleration)
        wanted = self.law(r, v, feed_forward, position_um * 1e-6)
        chosen = self.tuning.command_filter
        change = share(chosen.time_constant_s) * (wanted - self.command)
        self.command = clip(self.command + clip(change, chosen.slew_rad_s2 * PERIOD_S), 100 * math.pi)
        counts = math.floor(self.command / RAD_S_PER_COUNT + 0.5)
        self.sent = counts * RAD_S_PER_COUNT
        return counts

    def speed_for(self, velocity_m_s):
        front = self.tuning.front_end
        gain = front.extend_rad_per_m if velocity_m_s > 0 else front.retract_rad_per_m
        return gain * velocity_m_s


class FloatPiFf(FloatLaw):
    integral = 0.0

    def law(self, r, v, feed_forward, position_m):
        gains = self.tuning.pi
        self.integral += gains.ki_rad_s2_per_m * PERIOD_S * (r - position_m)
        return gains.kp_rad_s_per_m * (r - position_m) + self.integral + feed_forward


class FloatScheduled(FloatLaw):
    def __init__(self, tuning, position_um):
        super().__init__(tuning, position_um)
        self.z = [position_um * 1e-6, 0.0, 0.0]
        self.w = 0.0
        self.motor = 0.0

    def law(self, r, v, feed_forward, position_m):
        t = self.tuning.scheduled
        stiffness = self.stiffness(position_m)
        b0 = t.b0_m_s2_per_rad * stiffness
        front = self.tuning.front_end
        kappa = (front.extend_rad_per_m + front.retract_rad_per_m) / 2
        beta4 = t.omega_d_rad_s * (t.beta3_per_s3 + b0 * kappa * t.beta1_per_s)
        self.motor += share(t.motor_time_constant_s) * (self.sent - self.motor)
        z1, z2, z3 = self.z
        e = z1 - position_m
        jerk = b0 * (self.motor + self.w - self.speed_for(z2))
        self.z = [
            z1 + PERIOD_S * (z2 - t.beta1_per_s * e),
            z2 + PERIOD_S * (z3 - t.beta2_per_s2 * e),
            z3 + PERIOD_S * (jerk - t.beta3_per_s3 * e),
        ]
        self.w -= PERIOD_S * beta4 / b0 * e
        z1, z2, z3 = self.z
        k3 = t.k3_rad_s2_per_m + t.k3_soft_rad_s2_per_m / stiffness
        errors = t.k1_rad_s_per_m * (r + PERIOD_S * v - z1) + t.k2_rad_per_m * (v - z2)
        return errors - k3 * z3 - self.w + feed_forward

    def stiffness(self, position_m):
        """Eqs 20 to 22 without what cancels in a ratio."""
        t = self.tuning.scheduled

        def columns(x):
            return 1 / (x + t.end_a_m) + t.rod_side_weight / (t.stroke_m - x + t.end_b_m)

        return columns(min(max(position_m, 0.0), t.stroke_m)) / columns(t.reference_m)
