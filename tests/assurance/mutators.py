"""Small changes to a module's syntax tree, each one a fault that a test should notice."""

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from types import CodeType
from typing import Any

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}
LONG_TABLE = 32
"""Of more numbers in a row only the first and the last are changed: the rest would only raise the score."""
NOT_RUN = {"annotation", "returns", "decorator_list"}
"""Fields of syntax nodes that do nothing when the code runs interpreted."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one module.

    Attributes
    ----------
    file : str
        Path of the module.
    scope : str
        Qualified name of the outermost function changed; empty for what runs at import.
    line : str
        The source line, stripped: with `scope` it survives changes elsewhere in the file.
    change : str
        What became of what; " #2" marks the second such change of a line.
    line_number : int
        For people.
    """

    file: str
    scope: str
    line: str
    change: str
    line_number: int
    tree: ast.Module
    parent: ast.AST
    field: str
    index: int | None
    replacement: ast.AST

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What identifies it in the list of survivors."""
        return self.file, self.scope, self.line, self.change

    @property
    def where(self) -> str:
        """Place in the source."""
        return f"{self.file}:{self.line_number} in {self.scope or 'module'}"

    def compile(self, filename: str) -> CodeType:
        """Return the code of the changed module."""
        original = self._put(self.replacement)
        try:
            return compile(ast.fix_missing_locations(self.tree), filename, "exec")
        finally:
            self._put(original)

    def _put(self, node: ast.AST) -> ast.AST:
        holder: Any = getattr(self.parent, self.field)
        if self.index is None:
            setattr(self.parent, self.field, node)
            original: ast.AST = holder
        else:
            original = holder[self.index]
            holder[self.index] = node
        return original


def mutants(file: str, source: str) -> list[Mutant]:
    """Return all mutants of a module, in the order of its source."""
    tree, lines = ast.parse(source), source.splitlines()
    seen: Counter[tuple[str, str, str]] = Counter()
    found = []
    for scope, parent, field, index, node in _nodes(tree, ""):
        for replacement in _replacements(node, scope):
            ast.copy_location(replacement, node)
            line = lines[node.lineno - 1].strip()  # type: ignore[attr-defined]
            change = f"{_text(node)} -> {_text(replacement)}"
            seen[scope, line, change] += 1
            count = seen[scope, line, change]
            change += f" #{count}" if count > 1 else ""
            number = node.lineno  # type: ignore[attr-defined]
            found.append(Mutant(file, scope, line, change, number, tree, parent, field, index, replacement))
    return found


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.If | ast.While):
        return f"{type(node).__name__.lower()} {ast.unparse(node.test)}"
    return ast.unparse(node)


def _nodes(parent: ast.AST, scope: str) -> Iterator[tuple[str, ast.AST, str, int | None, ast.AST]]:
    """Every node that may be changed: its scope, and where it hangs."""
    named = isinstance(parent, ast.FunctionDef | ast.ClassDef)
    for field, value in ast.iter_fields(parent):
        if field in NOT_RUN:
            continue
        inner = scope
        if named and (field == "body" or isinstance(parent, ast.ClassDef)):
            inner = _nested(parent, scope)
        for index, node in _shortened(value):
            if isinstance(node, ast.AST) and not _is_text(node):
                yield _function(inner), parent, field, index, node
                yield from _nodes(node, inner)


def _shortened(value: Any) -> list[tuple[int | None, Any]]:
    if not isinstance(value, list):
        return [(None, value)]
    nodes = list(enumerate(value))
    is_long = len(nodes) > LONG_TABLE and all(isinstance(node, ast.Constant) for node in value)
    return [nodes[0], nodes[-1]] if is_long else nodes  # type: ignore[return-value]


def _nested(parent: Any, scope: str) -> str:
    """Scope within a class or function; a trailing dot marks a class, in whose body code runs at import."""
    if scope and not scope.endswith("."):
        return scope
    return scope + parent.name + ("." if isinstance(parent, ast.ClassDef) else "")


def _function(scope: str) -> str:
    return "" if scope.endswith(".") else scope


def _is_text(node: ast.AST) -> bool:
    value = node.value if isinstance(node, ast.Expr) else node
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _replacements(node: ast.AST, scope: str) -> Iterator[ast.AST]:
    match node:
        case ast.Compare(ops=[operator], left=left, comparators=[right]):
            for other in COMPARISONS[type(operator)]:
                yield ast.Compare(left, [other()], [right])
        case ast.Compare(ops=operators, left=left, comparators=rights):
            for place, operator in enumerate(operators):
                for other in COMPARISONS[type(operator)]:
                    yield ast.Compare(left, [*operators[:place], other(), *operators[place + 1 :]], rights)
        case ast.BoolOp(op=ast.And(), values=values):
            yield ast.BoolOp(ast.Or(), values)
        case ast.BoolOp(op=ast.Or(), values=values):
            yield ast.BoolOp(ast.And(), values)
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPERATORS:
            yield ast.BinOp(left, OPERATORS[type(operator)](), right)
        case ast.AugAssign(target=target, op=operator, value=value):
            yield ast.AugAssign(target, OPERATORS[type(operator)](), value)
            yield ast.Pass()
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
            yield operand
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1)
            yield ast.Constant(value - 1)
        case ast.Call(func=ast.Name(id="min" | "max")):
            pass
        case ast.Call(func=function, args=arguments, keywords=keywords):
            for place in range(len(arguments) - 1):
                if not any(isinstance(a, ast.Starred) for a in arguments[place : place + 2]):
                    swapped = [*arguments]
                    swapped[place : place + 2] = reversed(swapped[place : place + 2])
                    yield ast.Call(function, swapped, keywords)
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            yield ast.Return(ast.Constant(0))
        case ast.If(test=test, body=body, orelse=orelse) if not _has_own(test):
            yield ast.If(_negated(test), body, orelse)
        case ast.While(test=test, body=body, orelse=orelse) if not _has_own(test):
            yield ast.While(_negated(test), body, orelse)
        case ast.IfExp(test=test, body=body, orelse=orelse) if not _has_own(test):
            yield ast.IfExp(_negated(test), body, orelse)
        case ast.Expr():
            yield ast.Pass()
        case ast.Assign(targets=[target]) if scope or isinstance(target, ast.Subscript):
            yield ast.Pass()


def _negated(test: ast.expr) -> ast.expr:
    return ast.UnaryOp(ast.Not(), test)


def _has_own(test: ast.expr) -> bool:
    """Whether a condition's negation is among the mutants of the condition itself."""
    negatable = isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)
    return negatable or (isinstance(test, ast.Compare) and len(test.ops) == 1)
