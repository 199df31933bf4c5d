"""Functions of the restricted Python as C, statement by statement, with the widths of `kernel_check`."""

import ast
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from firmware_py.c_export.comments import WIDTH, Comments, comment, docstring
from firmware_py.kernel_check import Kind, Module

INDENT = "    "
TYPES: dict[Kind, str] = {32: "int32_t", 64: "int64_t", None: "void"}
OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.RShift: ">>",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.And: "&&",
    ast.Or: "||",
}
RESERVED = frozenset(
    {
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
    }
    | {"float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short"}
    | {"signed", "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile"}
    | {"while"}
)


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
        By the Python name.
    changed : mapping of str to set of str
        Array parameters of each function that it stores into, itself or through what it calls.
    """

    functions: Mapping[str, str]
    constants: Mapping[str, str]
    changed: Mapping[str, set[str]]


def c_integer(value: int) -> str:
    """Return an integer literal; the smallest of a width has none of its own."""
    if value == -(2**31):
        return "(-2147483647 - 1)"
    if -(2**31) < value < 2**31:
        return str(value)
    return f"INT64_C({value})"


class FunctionWriter:
    """Writes one function.

    Parameters
    ----------
    module : Module
        Where it stands.
    comments : Comments
        Those of the module.
    node : ast.FunctionDef
        The function.
    names : Names
        What it can refer to.
    """

    def __init__(self, module: Module, comments: Comments, node: ast.FunctionDef, names: Names) -> None:
        self._module = module
        self._comments = comments
        self._node = node
        self._names = names
        self._locals = {
            child.id
            for child in ast.walk(node)
            if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store)
        } - {argument.arg for argument in node.args.args}
        self._declared_at = self._declarations()

    def prototype(self) -> str:
        """Return the function's head."""
        signature = self._module.functions[self._node.name]
        changed = self._names.changed[self._node.name]
        parameters = []
        for argument, kind in zip(self._node.args.args, signature.parameters, strict=True):
            self._check_name(argument, argument.arg)
            if kind == "array":
                const = "" if argument.arg in changed else "const "
                parameters.append(f"{const}int32_t *{argument.arg}")
            else:
                parameters.append(f"{TYPES[kind]} {argument.arg}")
        return f"{TYPES[signature.result]} {self._names.functions[self._node.name]}({', '.join(parameters)})"

    def definition(self) -> Iterator[str]:
        """Yield the function's lines."""
        public = self._names.functions[self._node.name].startswith("ddh_")
        yield from comment(docstring(self._node))
        yield from _wrapped(("" if public else "static ") + self.prototype(), "")
        yield "{"
        used = {child.id for child in ast.walk(self._node) if isinstance(child, ast.Name)}
        for argument in self._node.args.args:
            if argument.arg not in used:
                yield f"{INDENT}(void){argument.arg};"
        yield from self._block(self._node.body[1:] if docstring(self._node) else self._node.body, INDENT)
        yield "}"

    def _declarations(self) -> dict[str, ast.stmt]:
        """Return for each local variable the statement that declares it.

        It is declared in the innermost block that contains every use, which has to begin with an assignment.
        """
        uses: dict[str, list[tuple[tuple[int, ...], ast.stmt]]] = {}

        def visit(body: list[ast.stmt], block: tuple[int, ...], loops: frozenset[str]) -> None:
            for statement in body:
                inside = loops | _loop_name(statement)
                for name in _own_names(statement):
                    if name.id in self._locals and name.id not in inside:
                        uses.setdefault(name.id, []).append((block, statement))
                for number, inner in enumerate(_inner_blocks(statement)):
                    visit(inner, (*block, statement.lineno, number), inside)

        visit(self._node.body, (), frozenset())
        declared: dict[str, ast.stmt] = {}
        for name, places in uses.items():
            common, first = places[0]
            for block, _ in places:
                while common != block[: len(common)]:
                    common = common[:-2]
            if places[0][0] != common or not isinstance(first, ast.Assign):
                raise self._error(first, f"{name} may be unset where it is used: assign it before the block")
            declared[name] = first
        return declared

    def _block(self, body: list[ast.stmt], indent: str) -> Iterator[str]:
        for statement in body:
            if above := self._comments.above.get(statement.lineno):
                yield from comment(above, indent)
            lines = list(self._statement(statement, indent))
            if beside := self._comments.beside.get(statement.lineno):
                lines[0] += f" /* {beside} */"
            yield from lines

    def _statement(self, node: ast.stmt, indent: str) -> Iterator[str]:
        match node:
            case ast.Assign(targets=[ast.Name(id=name) as target]):
                self._check_name(target, name)
                is_declared = self._declared_at.get(name) is node
                kind = f"{TYPES[self._module.kinds[target]]} " if is_declared else ""
                yield from _wrapped(f"{kind}{name} = {self._plain(node.value)};", indent)
            case ast.Assign(targets=[ast.Subscript() as target]):
                yield from _wrapped(f"{self._plain(target)} = {self._plain(node.value)};", indent)
            case ast.Return(value=None):
                yield f"{indent}return;"
            case ast.Return(value=ast.expr() as value):
                yield from _wrapped(f"return {self._plain(value)};", indent)
            case ast.Expr(value=ast.Call() as call):
                yield from _wrapped(f"{self._plain(call)};", indent)
            case ast.If():
                yield from self._if(node, indent, "if")
            case ast.While():
                yield from _wrapped(f"while ({self._plain(node.test)}) {{", indent)
                yield from self._block(node.body, indent + INDENT)
                yield f"{indent}}}"
            case ast.For(target=ast.Name(id=name) as target, iter=ast.Call(args=bounds)):
                self._check_name(target, name)
                if len(bounds) > 2:
                    raise self._error(node, "a range has no step")
                first, last = ["0", *map(self._plain, bounds)][-2:]
                yield f"{indent}for (int32_t {name} = {first}; {name} < {last}; {name}++) {{"
                yield from self._block(node.body, indent + INDENT)
                yield f"{indent}}}"
            case _:
                raise self._error(node, f"cannot be exported: {type(node).__name__}")

    def _if(self, node: ast.If, indent: str, keyword: str) -> Iterator[str]:
        yield from _wrapped(f"{keyword} ({self._plain(node.test)}) {{", indent)
        yield from self._block(node.body, indent + INDENT)
        match node.orelse:
            case []:
                yield f"{indent}}}"
            case [ast.If() as other]:
                yield from self._if(other, indent, "} else if")
            case body:
                yield f"{indent}}} else {{"
                yield from self._block(body, indent + INDENT)
                yield f"{indent}}}"

    def _plain(self, node: ast.expr) -> str:
        """Return an expression without parentheses around it."""
        match node:
            case ast.Constant(value=int() as value):
                return c_integer(value)
            case ast.Name(id=name):
                return self._names.constants.get(name, name)
            case ast.Subscript(value=array, slice=index):
                return f"{self._operand(array)}[{self._plain(index)}]"
            case ast.BinOp(op=ast.LShift()):
                width = 64 if self._module.kinds[node] == 64 else 32
                return f"shl{width}({self._plain(node.left)}, {self._plain(node.right)})"
            case ast.BinOp():
                return f"{self._left(node)} {OPERATORS[type(node.op)]} {self._operand(node.right)}"
            case ast.UnaryOp(op=ast.USub()):
                return f"-{self._operand(node.operand)}"
            case ast.UnaryOp(op=ast.Not()):
                return f"!({self._plain(node.operand)})"
            case ast.BoolOp():
                return f" {OPERATORS[type(node.op)]} ".join(self._operand(value) for value in node.values)
            case ast.Compare(ops=[operator], comparators=[right]):
                return f"{self._operand(node.left)} {OPERATORS[type(operator)]} {self._operand(right)}"
            case ast.Call(func=ast.Name(id=name)):
                return self._call(name, node)
            case _:
                raise self._error(node, f"cannot be exported: {ast.unparse(node)}")

    def _call(self, name: str, node: ast.Call) -> str:
        match name:
            case "i32":
                return f"(int32_t){self._operand(node.args[0])}"
            case "i64":
                return f"(int64_t){self._operand(node.args[0])}"
            case "low32":
                return f"(int32_t)(uint32_t){self._operand(node.args[0])}"
            case "clz":
                return f"clz({self._plain(node.args[0])})"
            case "div32":
                dividend, divisor = map(self._operand, node.args)
                return f"(int32_t)((uint32_t){dividend} / (uint32_t){divisor})"
            case "div":
                return f"{self._operand(node.args[0])} / {self._operand(node.args[1])}"
        return f"{self._names.functions[name]}({', '.join(map(self._plain, node.args))})"

    def _operand(self, node: ast.expr) -> str:
        """Return an expression as an operand of another one."""
        text = self._plain(node)
        is_division = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "div"
        is_shift = isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift)
        is_negative = text.startswith("-")
        is_operation = isinstance(node, ast.BinOp | ast.BoolOp | ast.Compare) and not is_shift
        return f"({text})" if is_operation or is_division or is_negative else text

    def _left(self, node: ast.BinOp) -> str:
        """Return the left operand; a chain of sums needs no parentheses."""
        sums = (ast.Add, ast.Sub)
        is_chain = (
            isinstance(node.op, sums) and isinstance(node.left, ast.BinOp) and isinstance(node.left.op, sums)
        )
        return self._plain(node.left) if is_chain else self._operand(node.left)

    def _check_name(self, node: ast.AST, name: str) -> None:
        if name in RESERVED or name in self._names.functions.values():
            raise self._error(node, f"{name} means something else in C: choose another name")

    def _error(self, node: ast.AST, reason: str) -> ExportError:
        return ExportError(f"{self._module.path}:{getattr(node, 'lineno', 0)}: {reason}")


def _loop_name(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.For) and isinstance(statement.target, ast.Name):
        return {statement.target.id}
    return set()


def _own_names(statement: ast.stmt) -> Iterator[ast.Name]:
    """Names in a statement, without those in the blocks it contains."""
    inner = {id(child) for block in _inner_blocks(statement) for child in block}
    todo: list[ast.AST] = [statement]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Name):
            yield node
        todo.extend(child for child in ast.iter_child_nodes(node) if id(child) not in inner)


def _inner_blocks(statement: ast.stmt) -> list[list[ast.stmt]]:
    return [block for name in ("body", "orelse") if (block := getattr(statement, name, None))]


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + 2 * INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
