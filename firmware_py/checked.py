"""Run the firmware's source, unmodified, on integers that check every operation at its width.

`load` executes the restricted modules with `i32` and `i64` making checked integers; `CheckedArray` stands for
the flat int32 arrays. An overflow, an unnarrowed store or a zero divisor raises where it happens.
"""

import importlib.util
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from dbc import machine
from firmware_py.kernel_check import MACHINE, module_names

LOW32, HIGH32 = -(2**31), 2**31 - 1
LOW64, HIGH64 = -(2**63), 2**63 - 1

Operation = Callable[[int, int], int]


class Int64(int):
    """A 64-bit integer; its operations raise OverflowError when the result leaves 64 bits."""

    __slots__ = ()


class Int32(int):
    """A 32-bit integer; with another one or a literal it stays 32-bit, with an `Int64` it widens."""

    __slots__ = ()


def _overflow(width: int, symbol: str, *operands: int) -> OverflowError:
    left = str(int(operands[0])) if len(operands) > 1 else ""
    return OverflowError(f"int{width} {symbol}: {left} {symbol} {int(operands[-1])}".replace("  ", " "))


def _checked64(symbol: str, operation: Operation, low: int = LOW64, high: int = HIGH64) -> Operation:
    def method(left: int, right: int) -> int:
        result = operation(left, right)
        if low <= result <= high:
            return Int64(result)
        raise _overflow(64, symbol, left, right)

    return method


def _checked32(symbol: str, operation: Operation, low: int = LOW32, high: int = HIGH32) -> Operation:
    wide = _checked64(symbol, operation)

    def method(left: int, right: int) -> int:
        if right.__class__ is Int64:
            return wide(left, right)
        result = operation(left, right)
        if low <= result <= high:
            return Int32(result)
        raise _overflow(32, symbol, left, right)

    return method


def _shifted(symbol: str, operation: Operation, integer: type[int], width: int) -> Operation:
    low, high = -(1 << width - 1), (1 << width - 1) - 1

    def method(value: int, count: int) -> int:
        if 0 <= count < width:
            result = operation(value, count)
            if low <= result <= high:
                return integer(result)
        raise _overflow(width, symbol, value, count)

    return method


def _negated(integer: type[int], width: int) -> Callable[[int], int]:
    low = -(1 << width - 1)

    def method(value: int) -> int:
        if value == low:
            raise _overflow(width, "-", value)
        return integer(int.__neg__(value))

    return method


def _forbidden(name: str) -> Callable[..., int]:
    def method(*operands: int) -> int:
        raise TypeError(f"the firmware's integers have no {name}")

    return method


def _install() -> None:
    for name, symbol, operation, reflected in (
        ("add", "+", int.__add__, int.__radd__),
        ("sub", "-", int.__sub__, int.__rsub__),
        ("mul", "*", int.__mul__, int.__rmul__),
        ("and", "&", int.__and__, int.__rand__),
        ("or", "|", int.__or__, int.__ror__),
        ("xor", "^", int.__xor__, int.__rxor__),
    ):
        for integer, checked in ((Int64, _checked64), (Int32, _checked32)):
            setattr(integer, f"__{name}__", checked(symbol, operation))
            setattr(integer, f"__r{name}__", checked(symbol, reflected))
    for integer, width in ((Int64, 64), (Int32, 32)):
        for name, symbol, operation in (("lshift", "<<", int.__lshift__), ("rshift", ">>", int.__rshift__)):
            setattr(integer, f"__{name}__", _shifted(symbol, operation, integer, width))
        integer.__neg__ = _negated(integer, width)  # type: ignore[method-assign]
        for name in ("floordiv", "truediv", "mod", "pow", "divmod", "invert"):
            setattr(integer, f"__{name}__", _forbidden(name))


_install()


def i32(value: int) -> Int32:
    """Narrow to 32 bits.

    Raises
    ------
    OverflowError
        When the value does not fit.
    """
    if LOW32 <= value <= HIGH32:
        return Int32(value)
    raise OverflowError(f"i32: {int(value)}")


def i64(value: int) -> Int64:
    """Widen to 64 bits."""
    if LOW64 <= value <= HIGH64:
        return Int64(value)
    raise OverflowError(f"i64: {int(value)}")


def low32(value: int) -> Int32:
    """Return the low 32 bits, in two's complement."""
    return Int32(machine.low32(int(value)))


def clz(value: int) -> Int32:
    """Leading zeros of a 64-bit value.

    Raises
    ------
    OverflowError
        When the value is not positive.
    """
    if not 0 < value <= HIGH64:
        raise OverflowError(f"clz: {int(value)}")
    return Int32(machine.clz(int(value)))


def div32(dividend: int, divisor: int) -> Int32:
    """Quotient of 32-bit integers that are not negative.

    Raises
    ------
    ZeroDivisionError, OverflowError
        When the divisor is zero, or an operand negative.
    """
    if dividend < 0 or divisor < 0:
        raise OverflowError(f"div32: {int(dividend)} / {int(divisor)}")
    return i32(machine.div32(int(dividend), int(divisor)))


class CheckedArray(list[int]):
    """Flat int32 array: loads give `Int32`, stores take what is already 32 bits wide.

    Parameters
    ----------
    words : iterable of int
        Initial values, each within 32 bits.
    """

    def __init__(self, words: Iterable[int]) -> None:
        super().__init__(i32(int(word)) for word in words)

    def __setitem__(self, index: Any, value: Any) -> None:
        if type(value) is not Int32:
            if type(value) is not int:
                raise TypeError(f"store of an unnarrowed {type(value).__name__} at index {index}")
            value = i32(value)
        super().__setitem__(index, value)


def load() -> dict[str, ModuleType]:
    """Execute the firmware on checked integers.

    Returns
    -------
    dict of str to module
        The modules by the last part of their names, ``load()["control"].control_step``. They can import
        nothing but each other and see no builtins but those of `machine`'s declarations.
    """
    names = module_names()
    modules: dict[str, ModuleType] = {}

    def load_module(name: str) -> ModuleType:
        if name in modules:
            return modules[name]
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(name)
        module = modules[name] = ModuleType(name)
        module.__dict__["__builtins__"] = {"__import__": import_restricted, "range": range, "len": len}
        if name == MACHINE:
            module.__dict__["__builtins__"] |= {"int": int, "memoryview": memoryview}
        exec(compile(Path(spec.origin).read_text(), spec.origin, "exec"), module.__dict__)
        if name == MACHINE:
            module.__dict__.update(i32=i32, i64=i64, low32=low32, clz=clz, div32=div32)
        for table, value in list(module.__dict__.items()):
            if type(value) is tuple:
                module.__dict__[table] = _checked_table(value)
        return module

    def import_restricted(
        name: str,
        globals: Mapping[str, Any] | None = None,
        locals: Mapping[str, Any] | None = None,
        fromlist: Sequence[str] | None = None,
        level: int = 0,
    ) -> ModuleType:
        if name not in names:
            raise ImportError(f"the firmware imports only itself, not {name}")
        return load_module(name)

    for name in names:
        load_module(name)
    return {name.rpartition(".")[2]: module for name, module in modules.items()}


def _checked_table(table: tuple[Any, ...]) -> Any:
    return tuple(map(_checked_table, table)) if isinstance(table[0], tuple) else CheckedArray(table)
