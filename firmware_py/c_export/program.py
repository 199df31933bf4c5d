"""All sources as one C program: what calls what, in which order, and under which names."""

import ast
from collections.abc import Iterator, Mapping

from firmware_py.c_export.comments import Comments, comment, docstring
from firmware_py.c_export.expressions import ExportError, ExpressionWriter, Names, c_integer, table_type
from firmware_py.c_export.functions import INDENT, FunctionWriter, wrapped
from firmware_py.kernel_check import MACHINE, analyse

PREFIX = "DDH_"


class Program:
    """Checked sources, ready to be written.

    Parameters
    ----------
    sources : mapping of str to (str, str)
        Path and source of each module by its name.
    public : tuple of str
        Functions for others to call; they are named ``ddh_...``.
    internal : tuple of str
        Further functions to export; what neither reach is left out.

    Raises
    ------
    ExportError
        If a source leaves the subset, or uses something there is no C for.
    """

    def __init__(
        self, sources: Mapping[str, tuple[str, str]], public: tuple[str, ...], internal: tuple[str, ...]
    ) -> None:
        modules, violations = analyse(sources)
        if violations:
            raise ExportError(violations[0])
        self._modules = {name: module for name, module in modules.items() if name != MACHINE}
        self._comments = {name: Comments(sources[name][1]) for name in self._modules}
        self._functions: dict[str, tuple[str, ast.FunctionDef]] = {}
        self._home: dict[str, str] = {}
        for name, module in self._modules.items():
            for node in module.tree.body:
                if isinstance(node, ast.FunctionDef):
                    self._define(name, node.name, node)
                    self._functions[node.name] = name, node
            for constant in (*module.constants, *module.tables):
                self._define(name, constant, module.tree)
        self._calls = {name: self._called_by(node) for name, (_, node) in self._functions.items()}
        self._order = self._reached((*public, *internal))
        self._names = Names(
            functions={name: f"ddh_{name}" if name in public else name.lstrip("_") for name in self._order},
            constants={
                name: PREFIX + name.lstrip("_")
                for module in self._modules.values()
                for name in (*module.constants, *module.tables)
            },
            tables={
                name: table for module in self._modules.values() for name, table in module.tables.items()
            },
            changed=self._changed(),
        )

    def prototypes(self, public: tuple[str, ...]) -> Iterator[str]:
        """Yield the heads of functions for others to call, with their comments."""
        for name in public:
            yield from comment(docstring(self._functions[name][1]))
            yield f"{self._writer(name).prototype()};"
            yield ""

    def constants(self, name: str) -> Iterator[str]:
        """Yield a module's constants: those of 32 bits as enumerators, wider ones as macros."""
        module, comments = self._modules[name], self._comments[name]
        is_open = False
        for node in module.tree.body:
            match node:
                case ast.Assign(targets=[ast.Name(id=constant)]) if constant in module.constants:
                    value = module.constants[constant]
                    is_wide = not -(2**31) <= value < 2**31
                    above = comments.above.get(node.lineno)
                    remark = comments.remark(node.lineno)
                    if is_open and (above or is_wide):
                        yield from ("};", "")
                        is_open = False
                    if above:
                        yield from comment(above)
                    c_name = self._names.constants[constant]
                    if is_wide:
                        yield from (f"#define {c_name} {c_integer(value)}{remark}", "")
                        continue
                    if not is_open:
                        yield "enum {"
                        is_open = True
                    yield f"{INDENT}{c_name} = {c_integer(value)},{remark}"
        if is_open:
            yield from ("};", "")

    def tables(self, name: str) -> Iterator[str]:
        """Yield a module's tables."""
        module, comments = self._modules[name], self._comments[name]
        write = ExpressionWriter(module, comments, self._names).plain
        for node in module.tree.body:
            match node:
                case ast.Assign(targets=[ast.Name(id=table)], value=ast.Tuple(elts=elements)):
                    values = module.tables[table]
                    sizes = f"[{len(values)}]"
                    if isinstance(values[0], tuple):
                        sizes += f"[{len(values[0])}]"
                    if above := comments.above.get(node.lineno):
                        yield from comment(above)
                    yield f"static const {table_type(values)} {self._names.constants[table]}{sizes} = {{"
                    if isinstance(values[0], tuple):
                        for row in elements:
                            assert isinstance(row, ast.Tuple)
                            words = ", ".join(map(write, row.elts))
                            yield f"{INDENT}{{{words}}},{comments.remark(row.lineno)}"
                    else:
                        yield from wrapped(", ".join(map(write, elements)), INDENT, hanging="")
                    yield from ("};", "")

    def module_names(self) -> list[str]:
        """Return the short names of the modules, each after those it calls."""
        homes = {self._functions[name][0] for name in self._order}
        return [name for name in self._imported_first() if name in homes or not self._modules[name].functions]

    def title(self, name: str) -> str:
        """Return the first paragraph of a module's docstring."""
        return docstring(self._modules[name].tree)

    def functions(self, name: str) -> Iterator[str]:
        """Yield a module's functions that are reached, each after those it calls."""
        for function in self._order:
            if self._functions[function][0] == name:
                yield from self._writer(function).definition()
                yield ""

    def _define(self, module: str, name: str, node: ast.AST) -> None:
        other = self._home.setdefault(name, module)
        if other != module:
            where = f"{self._modules[module].path}:{getattr(node, 'lineno', 1)}"
            raise ExportError(f"{where}: {name} is defined in {other} too, and C has one name space")

    def _called_by(self, node: ast.FunctionDef) -> list[str]:
        return [
            child.func.id
            for child in ast.walk(node)
            if isinstance(child, ast.Call)
            and isinstance(child.func, ast.Name)
            and child.func.id in self._functions
        ]

    def _reached(self, roots: tuple[str, ...]) -> list[str]:
        """Return what the roots call, module by module, each function after those it calls."""
        reached: set[str] = set()
        todo = list(roots)
        while todo:
            name = todo.pop()
            if name not in reached:
                reached.add(name)
                todo += self._calls[name]
        order: list[str] = []

        def visit(name: str, callers: tuple[str, ...]) -> None:
            if name in callers:
                raise self._error(name, f"recursion: {' -> '.join((*callers, name))}")
            for called in self._calls[name]:
                if self._functions[called][0] == self._functions[name][0]:
                    visit(called, (*callers, name))
            if name not in order:
                order.append(name)

        for module in self._imported_first():
            for name, (home, _) in self._functions.items():
                if home == module and name in reached:
                    visit(name, ())
        return order

    def _imported_first(self) -> list[str]:
        order: dict[str, None] = {}

        def visit(name: str) -> None:
            for node in self._modules[name].tree.body:
                if isinstance(node, ast.ImportFrom) and node.module in self._modules:
                    visit(node.module)
            order[name] = None

        for name in self._modules:
            visit(name)
        return list(order)

    def _changed(self) -> dict[str, set[str]]:
        changed: dict[str, set[str]] = {}
        for name in self._order:  # what it calls comes first
            node = self._functions[name][1]
            parameters = [argument.arg for argument in node.args.args]
            changed[name] = set()
            for child in ast.walk(node):
                match child:
                    case ast.Subscript(value=ast.Name(id=array), ctx=ast.Store()):
                        changed[name].add(array)
                    case ast.Call(func=ast.Name(id=called), args=arguments) if called in changed:
                        passed = self._functions[called][1].args.args
                        for argument, parameter in zip(arguments, passed, strict=True):
                            if isinstance(argument, ast.Name) and parameter.arg in changed[called]:
                                changed[name].add(argument.id)
            changed[name] &= set(parameters)
        return changed

    def _error(self, function: str, reason: str) -> ExportError:
        module, node = self._functions[function]
        return ExportError(f"{self._modules[module].path}:{node.lineno}: {reason}")

    def _writer(self, name: str) -> FunctionWriter:
        module, node = self._functions[name]
        return FunctionWriter(self._modules[module], self._comments[module], node, self._names)
