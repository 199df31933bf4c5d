"""Expressions of the restricted Python as C."""

import ast
from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.c_export.comments import Comments
from firmware_py.kernel_check import Module, Table

OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.RShift: ">>",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.BitXor: "^",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.And: "&&",
    ast.Or: "||",
}


class ExportError(ValueError):
    """A source that cannot be exported; the message is one line: ``path:line: reason``."""


@dataclass(frozen=True, slots=True)
class Names:
    """C names of what more than one function uses.

    Attributes
    ----------
    functions : mapping of str to str
        By the Python name.
    constants : mapping of str to str
        Constants and tables by the Python name.
    tables : mapping of str to Table
        Tables by the Python name.
    changed : mapping of str to set of str
        Array parameters of each function that it stores into, itself or through what it calls.
    """

    functions: Mapping[str, str]
    constants: Mapping[str, str]
    tables: Mapping[str, Table]
    changed: Mapping[str, set[str]]


def c_integer(value: int, digits: str = "") -> str:
    """Return an integer literal, if need be with its digits; the smallest of 32 bits has none of its own."""
    if value == -(2**31):
        return "(-2147483647 - 1)"
    digits = digits or str(value)
    return digits if -(2**31) < value < 2**31 else f"INT64_C({digits})"


def table_type(table: Table) -> str:
    """Return the C type of a table's elements: bytes where they fit."""
    elements = [value for row in table for value in (row if isinstance(row, tuple) else (row,))]
    return "uint8_t" if all(0 <= value <= 0xFF for value in elements) else "int32_t"


def local_name(name: str) -> str:
    """Return the C name of a local variable: an underscore marks one in Python that is not used."""
    return name.lstrip("_")


class ExpressionWriter:
    """Writes the expressions of one module.

    Parameters
    ----------
    module : Module
        The module.
    comments : Comments
        Its source.
    names : Names
        What it can refer to.
    """

    def __init__(self, module: Module, comments: Comments, names: Names) -> None:
        self._module = module
        self._comments = comments
        self._names = names

    def plain(self, node: ast.expr) -> str:
        """Return an expression without parentheses around it."""
        match node:
            case ast.Constant(value=int() as value):
                return c_integer(value, self._hexadecimal(node))
            case ast.Name(id=name):
                return self._names.constants.get(name) or local_name(name)
            case ast.Subscript():
                table = self._table_of(node)
                cast = "(int32_t)" if table is not None and table_type(table) != "int32_t" else ""
                return cast + self._element(node)
            case ast.BinOp(op=ast.LShift()):
                width = 64 if self._module.kinds[node] == 64 else 32
                return f"shl{width}({self.plain(node.left)}, {self.plain(node.right)})"
            case ast.BinOp():
                return f"{self._left(node)} {OPERATORS[type(node.op)]} {self._operand(node.right)}"
            case ast.UnaryOp(op=ast.USub()):
                return f"-{self._operand(node.operand)}"
            case ast.UnaryOp(op=ast.Not()):
                return f"!({self.plain(node.operand)})"
            case ast.BoolOp():
                return f" {OPERATORS[type(node.op)]} ".join(self._operand(value) for value in node.values)
            case ast.Compare(ops=[operator], comparators=[right]):
                return f"{self._operand(node.left)} {OPERATORS[type(operator)]} {self._operand(right)}"
            case ast.Call(func=ast.Name(id=name)):
                return self._call(name, node)
            case _:
                raise self.error(node, f"cannot be exported: {ast.unparse(node)}")

    def _element(self, node: ast.expr) -> str:
        if isinstance(node, ast.Subscript):
            return f"{self._element(node.value)}[{self.plain(node.slice)}]"
        return self.plain(node)

    def _table_of(self, node: ast.expr) -> Table | None:
        while isinstance(node, ast.Subscript):
            node = node.value
        return self._names.tables.get(node.id) if isinstance(node, ast.Name) else None

    def _call(self, name: str, node: ast.Call) -> str:
        match name:
            case "len":
                assert isinstance(node.args[0], ast.Name)
                return str(len(self._names.tables[node.args[0].id]))
            case "i32":
                return f"(int32_t){self._operand(node.args[0])}"
            case "i64":
                return f"(int64_t){self._operand(node.args[0])}"
            case "low32":
                return f"(int32_t)(uint32_t){self._operand(node.args[0])}"
            case "clz":
                return f"clz({self.plain(node.args[0])})"
            case "div32":
                dividend, divisor = map(self._operand, node.args)
                return f"(int32_t)((uint32_t){dividend} / (uint32_t){divisor})"
        return f"{self._names.functions[name]}({', '.join(map(self.plain, node.args))})"

    def _operand(self, node: ast.expr) -> str:
        """Return an expression as an operand of another one."""
        text = self.plain(node)
        is_shift = isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift)
        is_negative = text.startswith("-")
        is_operation = isinstance(node, ast.BinOp | ast.BoolOp | ast.Compare) and not is_shift
        return f"({text})" if is_operation or is_negative else text

    def _left(self, node: ast.BinOp) -> str:
        """Return the left operand; a chain of sums needs no parentheses."""
        sums = (ast.Add, ast.Sub)
        is_chain = (
            isinstance(node.op, sums) and isinstance(node.left, ast.BinOp) and isinstance(node.left.op, sums)
        )
        return self.plain(node.left) if is_chain else self._operand(node.left)

    def _hexadecimal(self, node: ast.Constant) -> str:
        """Return a literal as it is written, if it is written in base 16."""
        text = self._comments.lines[node.lineno - 1].encode()[node.col_offset : node.end_col_offset].decode()
        return text.replace("_", "") if text.startswith("0x") else ""

    def error(self, node: ast.AST, reason: str) -> ExportError:
        """Return an error about a node, with its place."""
        return ExportError(f"{self._module.path}:{getattr(node, 'lineno', 0)}: {reason}")
