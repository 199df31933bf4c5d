"""The kernel as machine code: numba compiles its unmodified source, bit-exact with `firmware_py.checked`.

Importing this module makes every kernel function callable from jitted code.
"""

import importlib
import pkgutil
from inspect import isfunction
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload, register_jitable

from dbc.jit import njit
from firmware_py import kernel
from firmware_py.kernel import control, machine

KERNEL = kernel.__name__


@intrinsic
def _leading_zeros(typing_context: Any, value: Any) -> Any:
    """Leading zeros of a positive 64-bit integer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctlz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


def _register() -> None:
    """Numba widens 32-bit arithmetic to 64 bits, so `i32` truncates where the source says so."""

    overload(machine.i32)(lambda value: lambda value: np.int32(value))
    overload(machine.i64)(lambda value: lambda value: np.int64(value))
    overload(machine.low32)(lambda value: lambda value: np.int32(value))
    overload(machine.clz)(lambda value: lambda value: np.int32(_leading_zeros(np.int64(value))))  # type: ignore[call-arg]
    overload(machine.div32)(
        lambda dividend, divisor: (
            lambda dividend, divisor: np.int32(np.uint32(dividend) // np.uint32(divisor))
        )
    )
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
