"""The firmware as machine code: numba compiles its unmodified source, bit-exact with `firmware_py.checked`.

Importing this module makes every restricted function callable from jitted code.
"""

import importlib

import dbc.e2e  # noqa: F401  (registers profile 2)
from dbc.jit import njit
from dbc.restricted import register
from firmware_py.kernel import control
from firmware_py.kernel_check import module_names

SOURCES = ("dbc.restricted", *module_names())

for _name in module_names():
    if _name.startswith("firmware_py."):
        register(importlib.import_module(_name))


@njit("void(int32[::1], int32[::1], int32[::1])", depends=SOURCES)
def control_reset(calibration, state, io):  # type: ignore[no-untyped-def]
    """See `firmware_py.kernel.control.control_reset`."""
    control.control_reset(calibration, state, io)


@njit("void(int32[::1], int32[::1], int32[::1])", depends=SOURCES)
def control_step(calibration, state, io):  # type: ignore[no-untyped-def]
    """See `firmware_py.kernel.control.control_step`."""
    control.control_step(calibration, state, io)
