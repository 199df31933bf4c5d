"""Functions of the restricted Python as C, statement by statement, with the widths of `kernel_check`."""

import ast
import textwrap
from collections.abc import Iterator

from firmware_py.c_export.comments import WIDTH, Comments, comment, docstring
from firmware_py.c_export.expressions import ExpressionWriter, Names, local_name
from firmware_py.kernel_check import Kind, Module

INDENT = "    "
TYPES: dict[Kind, str] = {32: "int32_t", 64: "int64_t", None: "void"}
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
        self._expressions = ExpressionWriter(module, comments, names)
        self._write = self._expressions.plain
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
        yield from wrapped(("" if public else "static ") + self.prototype(), "")
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
                raise self._expressions.error(
                    first, f"{name} may be unset where it is used: assign it before the block"
                )
            declared[name] = first
        return declared

    def _block(self, body: list[ast.stmt], indent: str) -> Iterator[str]:
        for statement in body:
            if above := self._comments.above.get(statement.lineno):
                yield from comment(above, indent)
            lines = list(self._statement(statement, indent))
            lines[0] += self._comments.remark(statement.lineno)
            yield from lines

    def _statement(self, node: ast.stmt, indent: str) -> Iterator[str]:
        match node:
            case ast.Assign(targets=[ast.Name(id=name) as target]):
                self._check_name(target, name)
                is_declared = self._declared_at.get(name) is node
                kind = f"{TYPES[self._module.kinds[target]]} " if is_declared else ""
                yield from wrapped(f"{kind}{name} = {self._write(node.value)};", indent)
            case ast.Assign(targets=[ast.Subscript() as target]):
                yield from wrapped(f"{self._write(target)} = {self._write(node.value)};", indent)
            case ast.Return(value=None):
                yield f"{indent}return;"
            case ast.Return(value=ast.expr() as value):
                yield from wrapped(f"return {self._write(value)};", indent)
            case ast.Expr(value=ast.Call() as call):
                yield from wrapped(f"{self._write(call)};", indent)
            case ast.If():
                yield from self._if(node, indent, "if")
            case ast.While():
                yield from wrapped(f"while ({self._write(node.test)}) {{", indent)
                yield from self._block(node.body, indent + INDENT)
                yield f"{indent}}}"
            case ast.For(target=ast.Name(id=name) as target, iter=ast.Call(args=bounds)):
                self._check_name(target, name)
                if len(bounds) > 2:
                    raise self._expressions.error(node, "a range has no step")
                first, last = ["0", *map(self._write, bounds)][-2:]
                name = local_name(name)
                yield f"{indent}for (int32_t {name} = {first}; {name} < {last}; {name}++) {{"
                yield from self._block(node.body, indent + INDENT)
                yield f"{indent}}}"
            case _:
                raise self._expressions.error(node, f"cannot be exported: {type(node).__name__}")

    def _if(self, node: ast.If, indent: str, keyword: str) -> Iterator[str]:
        yield from wrapped(f"{keyword} ({self._write(node.test)}) {{", indent)
        yield from self._block(node.body, indent + INDENT)
        match node.orelse:
            case []:
                yield f"{indent}}}"
            case [ast.If() as other]:
                head, *rest = self._if(other, indent, "} else if")
                yield head + self._comments.remark(other.lineno)
                yield from rest
            case body:
                yield f"{indent}}} else {{" + self._comments.remark(body[0].lineno - 1)
                yield from self._block(body, indent + INDENT)
                yield f"{indent}}}"

    def _check_name(self, node: ast.AST, name: str) -> None:
        if name in RESERVED or name in self._names.functions.values():
            raise self._expressions.error(node, f"{name} means something else in C: choose another name")


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


def wrapped(text: str, indent: str, hanging: str = 2 * INDENT) -> list[str]:
    """Break a line at spaces, where that looks well."""
    lines = textwrap.wrap(
        text.replace(" *", "\xa0*").replace(" {", "\xa0{"),
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\xa0", " ") for line in lines]
