"""Section 3 of the paper in plain SI floats, with the corrections its kernel counterpart has."""

import math

PERIOD_S = 1e-3
RAD_S_PER_COUNT = math.pi / 120


def fal(e, alpha, delta):
    """Normalised: e within +-delta, else sign(e) delta (|e| / delta)^alpha."""
    return e if abs(e) <= delta else math.copysign(delta * (abs(e) / delta) ** alpha, e)


def fhan(x1, x2, r, h):
    """Eq. 19."""
    d = r * h * h
    a0 = h * x2
    y = x1 + a0
    a = a0 + y if abs(y) <= d else a0 + math.copysign((math.sqrt(d * (d + 8 * abs(y))) - d) / 2, y)
    return -r * a / d if abs(a) <= d else -math.copysign(r, a)


class FloatAdrc:
    """Eqs 18, 26, 27; the command is clipped and quantised as on the bus.

    Parameters
    ----------
    tuning : AdrcTuning
    position_um : int
        Where it starts, at rest.
    """

    def __init__(self, tuning, position_um):
        self.tuning = tuning
        self.v = [position_um * 1e-6, 0.0, 0.0]
        self.z = [position_um * 1e-6, 0.0, 0.0, 0.0]
        self.u = 0.0

    def step(self, setpoint, position_um):
        """Setpoint in 0.1 um, position in um -> target velocity in 0.25 rpm."""
        self._differentiate(setpoint * 1e-7)
        self._observe(position_um * 1e-6)
        wanted = self._feedback()
        clipped = min(max(wanted, -100 * math.pi), 100 * math.pi)
        counts = math.floor(clipped / RAD_S_PER_COUNT + 0.5)
        self.u = counts * RAD_S_PER_COUNT
        return counts

    def _differentiate(self, setpoint_m):
        v1, v2, _ = self.v
        acceleration = fhan(v1 - setpoint_m, v2, self.tuning.r0_m_s2, self.tuning.h0_s)
        self.v = [v1 + PERIOD_S * v2, v2 + PERIOD_S * acceleration, acceleration]

    def _observe(self, position_m):
        t = self.tuning
        z1, z2, z3, z4 = self.z
        w = t.omega_o_rad_s
        e = z1 - position_m
        model = t.a1n_per_s2 * z2 + t.a2n_per_s * z3 + z4 + t.b0_m_s2_per_rad * self.u
        self.z = [
            z1 + PERIOD_S * (z2 - 4 * w * e),
            z2 + PERIOD_S * (z3 - 6 * w**2 * e),
            z3 + PERIOD_S * (model - 4 * w**3 * fal(e, 1 / 4, t.eso_delta_m)),
            z4 - PERIOD_S * w**4 * fal(e, 1 / 8, t.eso_delta_m),
        ]

    def _feedback(self):
        t = self.tuning
        v1, v2, v3 = self.v
        z1, z2, z3, z4 = self.z
        w = t.omega_c_rad_s
        u0 = w**3 * fal(v1 + 2 * t.h0_s * v2 - z1, 3 / 4, t.delta1_m)
        u0 += 3 * w**2 * fal(v2 + 2 * t.h0_s * v3 - z2, 3 / 4, t.delta2_m_s)
        u0 += 3 * w * fal(v3 - z3, 3 / 4, t.delta3_m_s2)
        return (u0 - z4 - t.a1n_per_s2 * z2 - t.a2n_per_s * z3) / t.b0_m_s2_per_rad
