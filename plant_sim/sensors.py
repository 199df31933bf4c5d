"""Position and pressure sensors: what they report as integers."""

import math

import numpy as np
from numba.extending import register_jitable

from dbc.jit import njit
from dbc.messages import BenchFault

_POSITION_UNIT_M = 1e-6
_PRESSURE_UNIT_PA = 1000.0


# words of a position sensor
(
    LSB_UM,  # resolution, µm
    STATUS,  # SensorStatus reported; 0 is Ok
    IS_STUCK,  # whether the position last reported is reported again
    IS_SILENT,  # whether nothing is reported
    REPORTED_UM,  # position last reported, µm; 0 before the first
) = range(5)
_SENSOR_SIZE = 5

_MAX_SENSOR_STATUS = 15


@njit("int64(float64, int64)")
def quantised_um(position_m, lsb_um):  # type: ignore[no-untyped-def]
    """Return a position as a signed 32-bit count of 1 µm (nearest step of `lsb_um`, half up, saturating)."""
    steps = math.floor(position_m / (lsb_um * _POSITION_UNIT_M) + 0.5)
    return min(max(np.int64(steps) * lsb_um, -(2**31)), 2**31 - 1)


@register_jitable
def reported_um(sensor, position_m):  # type: ignore[no-untyped-def]
    """Return what a sensor of these words reports of a position that includes the sensor's error."""
    if not sensor[IS_STUCK]:
        sensor[REPORTED_UM] = quantised_um(position_m, sensor[LSB_UM])
    return sensor[REPORTED_UM]


class PositionSensor:
    """Absolute position sensor that reports micrometres, and its faults.

    Bias, drift and noise add to the position before it is quantised. A stuck sensor reports the position that
    it reported last, with a counter and a CRC that go on. A silent one sends nothing, so its counter rests
    too: a counter counts what was sent (what is lost on the way is a fault of the bus).

    Parameters
    ----------
    lsb_m : float
        Resolution, a whole number of micrometres. The report stays in micrometres: 0, 10, 20 with 10 µm.
    noise_rms_m : float
        Standard deviation of white Gaussian noise added before quantisation.
    seed : int
        Of the noise; equal seeds give equal noise.

    Attributes
    ----------
    words : array of int64
        What `reported_um` works on.
    is_silent : bool
        Whether nothing is reported.
    is_plain : bool
        Whether it reports, and without an error before quantisation.

    Raises
    ------
    ValueError
        If `lsb_m` is not a whole number of micrometres or `noise_rms_m` is negative.
    """

    def __init__(self, lsb_m: float = 1e-6, noise_rms_m: float = 0.0, seed: int = 0) -> None:
        lsb_um = round(lsb_m / _POSITION_UNIT_M) if math.isfinite(lsb_m) else 0
        if lsb_um < 1 or not math.isclose(lsb_m, lsb_um * _POSITION_UNIT_M):
            raise ValueError(f"lsb_m is {lsb_m!r}, must be a whole number of micrometres")
        if not (math.isfinite(noise_rms_m) and noise_rms_m >= 0.0):
            raise ValueError(f"noise_rms_m is {noise_rms_m!r}, must be zero or positive")
        self._noise_rms_m = noise_rms_m
        self._seed = seed
        self.words = np.zeros(_SENSOR_SIZE, np.int64)
        self.words[LSB_UM] = lsb_um
        self.restart()

    def restart(self) -> None:
        """Power-on: no fault, nothing reported yet, the noise begins anew."""
        self._random = np.random.default_rng(self._seed)
        self.words[REPORTED_UM] = 0
        self._drift_since_ns = 0
        self._take(dict.fromkeys(BenchFault, 0.0))

    def set_fault(self, fault: BenchFault, value: float, now_ns: int) -> None:
        """Switch a fault on or, with 0, off; `BenchFault.NONE` switches all of them off.

        Parameters
        ----------
        fault : BenchFault
        value : float
            In the fault's unit.
        now_ns : int
            When a drift begins, also one that is set anew.
        """
        if fault == BenchFault.SENSOR_DRIFT:
            self._drift_since_ns = now_ns
        none = dict.fromkeys(BenchFault, 0.0)
        self._take(none if fault == BenchFault.NONE else self._faults | {fault: value})

    def error_m(self, now_ns: int) -> float:
        """Return the error of the reading at `now_ns` before quantisation, m."""
        if self._is_exact:
            return 0.0
        drift_m = self._drift_m_s * (now_ns - self._drift_since_ns) * 1e-9
        noise_m = self._total_noise_rms_m * self._random.standard_normal() if self._total_noise_rms_m else 0.0
        return self._bias_m + drift_m + noise_m

    def read(self, position_m: float, now_ns: int = 0) -> int:
        """Return what is reported of a position at `now_ns`, µm."""
        return int(reported_um(self.words, position_m + self.error_m(now_ns)))

    def _take(self, faults: dict[BenchFault, float]) -> None:
        self._faults = faults
        status = round(faults[BenchFault.SENSOR_STATUS])
        self.words[STATUS] = min(max(status, 0), _MAX_SENSOR_STATUS)
        self.words[IS_STUCK] = faults[BenchFault.SENSOR_STUCK] != 0.0
        self.words[IS_SILENT] = self.is_silent = faults[BenchFault.SENSOR_DROPOUT] != 0.0
        self._bias_m = faults[BenchFault.SENSOR_BIAS]
        self._drift_m_s = faults[BenchFault.SENSOR_DRIFT]
        self._total_noise_rms_m = math.hypot(self._noise_rms_m, faults[BenchFault.SENSOR_NOISE])
        self._is_exact = not (self._bias_m or self._drift_m_s or self._total_noise_rms_m)
        self.is_plain = self._is_exact and not self.is_silent


def pressure_count(pressure_pa: float) -> int:
    """Return an absolute pressure as an unsigned 16-bit count of 0.01 bar (nearest, half up, saturating).

    Examples
    --------
    >>> pressure_count(3.5e5)
    350
    """
    return min(max(math.floor(pressure_pa / _PRESSURE_UNIT_PA + 0.5), 0), 2**16 - 1)
