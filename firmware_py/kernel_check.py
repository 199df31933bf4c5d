"""Check that the firmware stays in its restricted Python: ``python -m firmware_py.kernel_check``.

Widths are C's and are known without running anything: elements of arrays and tables have 32 bits, so have
literals, annotations give those of parameters and results, a variable keeps the width of its first
assignment. The subset is small enough to transpile: constants, tables, assignments, if, while, for over a
constant range, calls, returns of one scalar.
"""

import ast
import importlib.util
import operator
import pkgutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from firmware_py import kernel

MACHINE = "dbc.machine"
"""The module that declares the machine words; the only one whose bodies are not in the subset."""

MODULES = (
    MACHINE,
    "dbc.profile2",
    "firmware_py.task_layout",
    "firmware_py.signals",
    "firmware_py.mailbox",
    "firmware_py.state_machine",
    "firmware_py.calibration_block",
    "firmware_py.supervision",
    "firmware_py.task",
)
"""What is in the subset, beside the control kernel."""

Kind = int | str | None
"""Width 32 or 64, "literal" (any width), "array", "table", "table of rows", "bool", None for no value."""

Table = tuple[int, ...] | tuple[tuple[int, ...], ...]

WIDTHS: dict[str, Kind] = {"int32": 32, "int64": 64, "Array32": "array", "None": None}
OPERATIONS: dict[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
}
BITWISE = (ast.BitAnd, ast.BitOr, ast.BitXor, ast.RShift)
"""What leaves no width that its operands fit in."""

ALLOCATIONS = (
    ast.List,
    ast.Dict,
    ast.Set,
    ast.Tuple,
    ast.ListComp,
    ast.DictComp,
    ast.SetComp,
    ast.GeneratorExp,
    ast.JoinedStr,
    ast.Lambda,
)


@dataclass(frozen=True, slots=True)
class Signature:
    """Kinds of a kernel function's parameters and of its result."""

    parameters: tuple[Kind, ...]
    result: Kind


@dataclass(slots=True)
class Module:
    """What a module defines."""

    path: str
    tree: ast.Module
    constants: dict[str, int] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)
    functions: dict[str, Signature] = field(default_factory=dict)
    kinds: dict[ast.expr, Kind] = field(default_factory=dict)
    """Kind of each expression and of each assigned name in the functions' bodies."""


class Violation(Exception):  # noqa: N818
    """A node outside the subset; ends the walk through its statement."""

    def __init__(self, node: ast.AST, message: str) -> None:
        super().__init__(f"{getattr(node, 'lineno', 0)}: {message}")


def module_names() -> tuple[str, ...]:
    """Return the names of all modules that are in the subset."""
    return (*MODULES, *(info.name for info in pkgutil.iter_modules(kernel.__path__, kernel.__name__ + ".")))


def firmware_sources() -> dict[str, tuple[str, str]]:
    """Return path and source of each module by its name."""
    sources = {}
    for name in module_names():
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        sources[name] = (spec.origin, Path(spec.origin).read_text(encoding="utf-8"))
    return sources


def check(sources: Mapping[str, tuple[str, str]]) -> list[str]:
    """Check modules against each other.

    Parameters
    ----------
    sources : mapping of str to (str, str)
        Path and source of each module by its name.

    Returns
    -------
    list of str
        One line for each violation: ``path:line: message``.
    """
    return analyse(sources)[1]


def analyse(sources: Mapping[str, tuple[str, str]]) -> tuple[dict[str, Module], list[str]]:
    """Check modules as `check` does; return also what is known of each by its name."""
    modules: dict[str, Module] = {}
    for name in sources:
        _declare(name, sources, modules)
    violations = []
    for name, module in modules.items():
        for line in _ModuleChecker(module, modules).violations(bodies=name != MACHINE):
            violations.append(f"{module.path}:{line}")
    return modules, violations


def _declare(name: str, sources: Mapping[str, tuple[str, str]], modules: dict[str, Module]) -> Module:
    """Find out what a module defines, and first what those define that it imports."""
    if name in modules:
        return modules[name]
    path, source = sources[name]
    tree = ast.parse(source)
    module = modules[name] = Module(path, tree)
    known: dict[str, int] = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module in sources:
            known |= _declare(node.module, sources, modules).constants
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            constant = node.targets[0].id
            value = _constant(node.value, known)
            if value is not None:
                module.constants[constant] = known[constant] = value
            table = _table(node.value, known)
            if table is not None:
                module.tables[constant] = table
        if isinstance(node, ast.FunctionDef):
            kinds = [_annotated(argument.annotation) for argument in node.args.args]
            module.functions[node.name] = Signature(tuple(kinds), _annotated(node.returns))
    del modules[name]  # behind those it imports
    modules[name] = module
    return module


def _constant(node: ast.expr, known: Mapping[str, int]) -> int | None:
    match node:
        case ast.Constant() if type(node.value) is int:
            return node.value
        case ast.Name(id=name):
            return known.get(name)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            value = _constant(operand, known)
            return None if value is None else -value
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in OPERATIONS:
            values = _constant(left, known), _constant(right, known)
            if values[0] is None or values[1] is None:
                return None
            return OPERATIONS[type(operation)](values[0], values[1])
    return None


def _table(node: ast.expr, known: Mapping[str, int]) -> Table | None:
    """Return what a tuple of 32-bit constants holds, or one of equally long tuples of them."""
    if not isinstance(node, ast.Tuple) or not node.elts:
        return None
    rows = [_row(element, known) for element in node.elts if isinstance(element, ast.Tuple)]
    if not rows:
        return _row(node, known)
    whole = tuple(row for row in rows if row is not None)
    return whole if len(whole) == len(node.elts) and len({len(row) for row in whole}) == 1 else None


def _row(node: ast.Tuple, known: Mapping[str, int]) -> tuple[int, ...] | None:
    values = tuple(_constant(element, known) for element in node.elts)
    row = tuple(value for value in values if value is not None and _of_constant(value) != 64)
    return row if row and len(row) == len(values) else None


def _annotated(annotation: ast.expr | None) -> Kind:
    text = "" if annotation is None else ast.unparse(annotation)
    return WIDTHS.get(text, "unknown")


def _of_constant(value: int) -> Kind:
    return "literal" if -(2**31) <= value < 2**31 else 64


@dataclass(slots=True)
class _ModuleChecker:
    module: Module
    modules: Mapping[str, Module]
    constants: dict[str, int] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)
    functions: dict[str, Signature] = field(default_factory=dict)

    def violations(self, *, bodies: bool) -> Iterator[str]:
        for position, node in enumerate(self.module.tree.body):
            try:
                if isinstance(node, ast.ImportFrom):
                    self._import(node)
                elif isinstance(node, ast.FunctionDef):
                    self.functions[node.name] = self.module.functions[node.name]
                elif isinstance(node, ast.Assign) and not bodies:
                    continue
                elif not (position == 0 and _is_docstring(node)):
                    self._constant(node)
            except Violation as violation:
                yield str(violation)
        self.functions |= self.module.functions
        if bodies:
            for node in self.module.tree.body:
                if isinstance(node, ast.FunctionDef):
                    checker = _FunctionChecker(self.constants, self.tables, self.functions, self.module.kinds)
                    yield from checker.violations(node)

    def _import(self, node: ast.ImportFrom) -> None:
        source = self.modules.get(node.module or "")
        if source is None:
            raise Violation(node, f"import from outside the subset: {node.module}")
        for alias in node.names:
            if alias.name in source.functions:
                self.functions[alias.name] = source.functions[alias.name]
            elif alias.name in source.constants:
                self.constants[alias.name] = source.constants[alias.name]
            elif alias.name in source.tables:
                self.tables[alias.name] = source.tables[alias.name]
            elif alias.name not in WIDTHS:
                raise Violation(node, f"import of {alias.name}, which is no function, constant or table")

    def _constant(self, node: ast.stmt) -> None:
        if isinstance(node, ast.Import):
            raise Violation(node, f"import from outside the subset: {node.names[0].name}")
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name in self.module.constants:
                self.constants[name] = self.module.constants[name]
                return
            if name in self.module.tables:
                self.tables[name] = self.module.tables[name]
                return
        raise Violation(node, "a module holds only imports, integer constants, tables and functions")


def _is_docstring(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


class _FunctionChecker:
    """Walks one function; `variables` holds the kinds of its names.

    What it finds out of expressions and assigned names goes to `kinds`.
    """

    def __init__(
        self,
        constants: Mapping[str, int],
        tables: Mapping[str, Table],
        functions: Mapping[str, Signature],
        kinds: dict[ast.expr, Kind],
    ) -> None:
        self.constants = constants
        self.tables = tables
        self.functions = functions
        self.kinds = kinds
        self.variables: dict[str, Kind] = {}
        self.result: Kind = None

    def violations(self, function: ast.FunctionDef) -> Iterator[str]:
        signature = self.functions[function.name]
        self.result = signature.result
        arguments = function.args
        if "unknown" in (*signature.parameters, signature.result) or signature.result == "array":
            yield f"{function.lineno}: {function.name}: annotate with int32, int64, Array32, None"
            return
        if function.decorator_list or arguments.defaults or arguments.vararg or arguments.kwonlyargs:
            yield f"{function.lineno}: {function.name}: only plain positional parameters, no decorators"
        for argument, kind in zip(arguments.args, signature.parameters, strict=True):
            self.variables[argument.arg] = kind
        body = function.body[1:] if _is_docstring(function.body[0]) else function.body
        yield from self._block(body)

    def _block(self, body: Iterable[ast.stmt]) -> Iterator[str]:
        for statement in body:
            try:
                yield from self._statement(statement)
            except Violation as violation:
                yield str(violation)

    def _statement(self, node: ast.stmt) -> Iterator[str]:
        match node:
            case ast.Assign(targets=[ast.Name() as target]):
                self._assign(target, self._number(node.value))
            case ast.Assign(targets=[ast.Subscript(value=array) as target]):
                if self._kind(target) != 32 or self._kind(array) != "array":
                    raise Violation(node, f"not an array: {ast.unparse(array)}")
                self._narrowed(node.value, "unnarrowed store")
            case ast.Return(value=None):
                if self.result is not None:
                    raise Violation(node, "a return without its value")
            case ast.Return(value=value):
                assert value is not None
                self._return(value)
            case ast.Expr(value=ast.Call() as call):
                self._kind(call)
            case ast.If() | ast.While():
                yield from self._branch(node)
            case ast.For():
                yield from self._loop(node)
            case _:
                raise Violation(node, f"not in the subset: {type(node).__name__}")

    def _assign(self, target: ast.Name, kind: Kind) -> None:
        known = self.variables.setdefault(target.id, 32 if kind == "literal" else kind)
        if kind not in (known, "literal"):
            raise Violation(target, f"width of {target.id} changes from {known} to {kind}")
        self.kinds[target] = known

    def _return(self, value: ast.expr) -> None:
        if self.result == 32:
            self._narrowed(value, "unnarrowed result")
        elif self._number(value) not in (self.result, "literal"):
            raise Violation(value, f"result is not int{self.result}")

    def _branch(self, node: ast.If | ast.While) -> Iterator[str]:
        if self._kind(node.test) != "bool":
            raise Violation(node, "a condition is a comparison")
        yield from self._block(node.body)
        if isinstance(node, ast.While) and node.orelse:
            raise Violation(node, "not in the subset: else of a loop")
        yield from self._block(node.orelse)

    def _loop(self, node: ast.For) -> Iterator[str]:
        match node:
            case ast.For(
                target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=bounds), orelse=[]
            ):
                if any(self._kind(bound) != "literal" for bound in bounds):
                    raise Violation(node, "the bounds of a for are constants")
                self.kinds[node.target] = self.variables[name] = 32
                yield from self._block(node.body)
            case _:
                raise Violation(node, "not in the subset: a for that does not run over a constant range")

    def _narrowed(self, value: ast.expr, message: str) -> None:
        """Allow what is already 32 bits wide; a 32-bit sum or negation has to say `i32` or `sat32`."""
        kind = self._number(value)
        is_bitwise = isinstance(value, ast.BinOp) and isinstance(value.op, BITWISE)
        is_arithmetic = isinstance(value, ast.BinOp | ast.UnaryOp) and _constant(value, {}) is None
        if kind not in (32, "literal") or (is_arithmetic and not is_bitwise):
            raise Violation(value, f"{message}: {ast.unparse(value)}")

    def _number(self, node: ast.expr) -> Kind:
        kind = self._kind(node)
        if kind not in (32, 64, "literal"):
            raise Violation(node, f"not an integer: {ast.unparse(node)}")
        return kind

    def _kind(self, node: ast.expr) -> Kind:
        kind = self.kinds[node] = self._kind_of(node)
        return kind

    def _kind_of(self, node: ast.expr) -> Kind:
        match node:
            case ast.Constant(value=float()):
                raise Violation(node, f"float literal {ast.unparse(node)}")
            case ast.Constant() if type(node.value) is int:
                return _of_constant(node.value)
            case ast.Name(id=name) if name in self.variables:
                return self.variables[name]
            case ast.Name(id=name) if name in self.constants:
                return _of_constant(self.constants[name])
            case ast.Name(id=name) if name in self.tables:
                return "table" if isinstance(self.tables[name][0], int) else "table of rows"
            case ast.Name(id=name):
                raise Violation(node, f"{name} is unknown here")
            case ast.Subscript(value=ast.Name() | ast.Subscript() as indexed):
                return self._element(node, self._kind(indexed))
            case ast.BinOp():
                return self._operation(node)
            case ast.UnaryOp(op=ast.USub()):
                return self._number(node.operand)
            case ast.UnaryOp(op=ast.Not()) | ast.BoolOp():
                parts = node.values if isinstance(node, ast.BoolOp) else [node.operand]
                if any(self._kind(part) != "bool" for part in parts):
                    raise Violation(node, "a condition is a comparison")
                return "bool"
            case ast.Compare(ops=[_]):
                self._number(node.left)
                self._number(node.comparators[0])
                return "bool"
            case ast.Call(func=ast.Name()):
                return self._call(node)
            case _ if isinstance(node, ALLOCATIONS):
                raise Violation(node, f"allocation: {type(node).__name__}")
            case _:
                raise Violation(node, f"not in the subset: {type(node).__name__}")

    def _element(self, node: ast.Subscript, indexed: Kind) -> Kind:
        if indexed not in ("array", "table", "table of rows"):
            raise Violation(node, f"not an array: {ast.unparse(node.value)}")
        if self._number(node.slice) == 64:
            raise Violation(node, "a 64-bit index")
        return "table" if indexed == "table of rows" else 32

    def _operation(self, node: ast.BinOp) -> Kind:
        if isinstance(node.op, ast.Div | ast.FloorDiv | ast.Mod):
            raise Violation(node, f"division by an operator, use div32: {ast.unparse(node)}")
        if type(node.op) not in OPERATIONS:
            raise Violation(node, f"not in the subset: {type(node.op).__name__}")
        left, right = self._number(node.left), self._number(node.right)
        if isinstance(node.op, ast.Mult) and (left, right) != (64, 64):
            raise Violation(node, f"product without 64-bit operands: {ast.unparse(node)}")
        if isinstance(node.op, ast.LShift | ast.RShift):
            return 32 if left == "literal" else left
        return 64 if 64 in (left, right) else 32

    def _call(self, node: ast.Call) -> Kind:
        assert isinstance(node.func, ast.Name)
        name = node.func.id
        match node:
            case ast.Call(func=ast.Name(id="len"), args=[ast.Name(id=table)]) if table in self.tables:
                return "literal"
        signature = self.functions.get(name)
        if signature is None:
            raise Violation(node, f"call of {name}, which is no function of the subset")
        if node.keywords or len(node.args) != len(signature.parameters):
            raise Violation(node, f"{name} takes {len(signature.parameters)} positional arguments")
        for argument, expected in zip(node.args, signature.parameters, strict=True):
            kind = self._kind(argument)
            fits = kind == expected or (kind == "literal" and expected in (32, 64))
            if not fits and not (name in ("i32", "i64") and kind in (32, 64)):
                raise Violation(argument, f"{name} takes {expected}, not {kind}: {ast.unparse(argument)}")
        return signature.result


def main() -> int:
    """Check the firmware; print one line per violation."""
    violations = check(firmware_sources())
    for violation in violations:
        print(violation)
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
