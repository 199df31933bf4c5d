"""Active disturbance rejection control: tracking differentiator, observer, feedback, in this order."""

from dbc.machine import Array32, int32
from firmware_py.kernel.eso import eso_reset, eso_step
from firmware_py.kernel.nfcl import nfcl
from firmware_py.kernel.td import td_reset, td_step


def adrc_reset(state: Array32, position: int32) -> None:
    """Start at rest at `position` (2^-31 m)."""
    td_reset(state, position)
    eso_reset(state, position)


def adrc_step(calibration: Array32, state: Array32, setpoint: int32, position: int32) -> int32:
    """Wanted speed (2^-20 rad/s) from `setpoint` and `position` (2^-31 m); feedback on the k+1 values."""
    td_step(calibration, state, setpoint)
    eso_step(calibration, state, position)
    return nfcl(calibration, state)
