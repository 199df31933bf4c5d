"""Position and pressure sensors: what they report as integers."""

import math

import numpy as np

from dbc.jit import njit

_POSITION_UNIT_M = 1e-6
_PRESSURE_UNIT_PA = 1000.0


@njit("int64(float64, int64)")
def quantised_um(position_m, lsb_um):  # type: ignore[no-untyped-def]
    """Return a position as a signed 32-bit count of 1 µm (nearest step of `lsb_um`, half up, saturating)."""
    steps = math.floor(position_m / (lsb_um * _POSITION_UNIT_M) + 0.5)
    return min(max(np.int64(steps) * lsb_um, -(2**31)), 2**31 - 1)


class PositionSensor:
    """Absolute position sensor that reports micrometres.

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
    lsb_um : int
        Resolution, µm.

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
        self.lsb_um = lsb_um
        self._noise_rms_m = noise_rms_m
        self._seed = seed
        self.restart()

    def restart(self) -> None:
        """Begin the noise anew."""
        self._random = np.random.default_rng(self._seed)

    def noise_m(self) -> float:
        """Return the error of the next reading before quantisation, m."""
        return self._noise_rms_m * self._random.standard_normal() if self._noise_rms_m else 0.0

    def read(self, position_m: float) -> int:
        """Return a position with its noise as `quantised_um` does."""
        return int(quantised_um(position_m + self.noise_m(), self.lsb_um))


def pressure_count(pressure_pa: float) -> int:
    """Return an absolute pressure as an unsigned 16-bit count of 0.01 bar (nearest, half up, saturating).

    Examples
    --------
    >>> pressure_count(3.5e5)
    350
    """
    return min(max(math.floor(pressure_pa / _PRESSURE_UNIT_PA + 0.5), 0), 2**16 - 1)
