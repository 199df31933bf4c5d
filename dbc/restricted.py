"""Restricted Python as machine code: numba compiles its unmodified source.

What is restricted about it says `firmware_py.kernel_check`.
"""

from inspect import isfunction
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload, register_jitable

from dbc import machine


@intrinsic
def _leading_zeros(typing_context: Any, value: Any) -> Any:
    """Leading zeros of a positive 64-bit integer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctlz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


# numba widens 32-bit arithmetic to 64 bits, so `i32` truncates where the source says so
overload(machine.i32)(lambda value: lambda value: np.int32(value))
overload(machine.i64)(lambda value: lambda value: np.int64(value))
overload(machine.low32)(lambda value: lambda value: np.int32(value))
overload(machine.clz)(lambda value: lambda value: np.int32(_leading_zeros(np.int64(value))))  # type: ignore[call-arg]
overload(machine.div32)(
    lambda dividend, divisor: lambda dividend, divisor: np.int32(np.uint32(dividend) // np.uint32(divisor))
)


@register_jitable
def low_half(data):  # type: ignore[no-untyped-def]
    """Bytes 0 to 3 of a payload, which is a uint64."""
    return np.int64(data & np.uint64(0xFFFF_FFFF))


@register_jitable
def high_half(data):  # type: ignore[no-untyped-def]
    """Bytes 4 to 7 of a payload, which is a uint64."""
    return np.int64(data >> np.uint64(32))


def register(module: ModuleType) -> None:
    """Make a module's functions callable from jitted code; its tables become arrays there."""
    tables = {name: np.array(value, np.int32) for name, value in vars(module).items() if type(value) is tuple}
    for name, function in vars(module).items():
        if isfunction(function) and function.__module__ == module.__name__:
            compilable = FunctionType(function.__code__, vars(module) | tables, name)
            overload(function, strict=False)(lambda *_, _compilable=compilable: _compilable)
