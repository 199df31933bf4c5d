"""The kernel as machine code: numba compiles its unmodified source, bit-exact with `firmware_py.checked`.

Importing this module makes every kernel function callable from jitted code.
"""

import importlib
import pkgutil
from inspect import isfunction

import numpy as np
from numba.extending import overload, register_jitable

from dbc.jit import njit
from firmware_py import kernel
from firmware_py.kernel import control, machine

KERNEL = kernel.__name__


def _register() -> None:
    """Numba widens 32-bit arithmetic to 64 bits, so `i32` truncates where the source says so."""

    overload(machine.i32)(lambda value: lambda value: np.int32(value))
    overload(machine.i64)(lambda value: lambda value: np.int64(value))
    register_jitable(machine.div)
    for info in pkgutil.iter_modules(kernel.__path__, KERNEL + "."):
        module = importlib.import_module(info.name)
        for function in vars(module).values():
            if isfunction(function) and function.__module__ == info.name != machine.__name__:
                register_jitable(function)


_register()


@njit("void(int32[::1], int32[::1], int32[::1])", depends=(KERNEL,))
def control_reset(calibration, state, io):  # type: ignore[no-untyped-def]
    """See `firmware_py.kernel.control.control_reset`."""
    control.control_reset(calibration, state, io)


@njit("void(int32[::1], int32[::1], int32[::1])", depends=(KERNEL,))
def control_step(calibration, state, io):  # type: ignore[no-untyped-def]
    """See `firmware_py.kernel.control.control_step`."""
    control.control_step(calibration, state, io)
