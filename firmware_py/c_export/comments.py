"""Comments and docstrings, from Python to C."""

import ast
import io
import textwrap
import tokenize
from collections.abc import Iterator

WIDTH = 116


class Comments:
    """Where the comments of a source stand.

    Parameters
    ----------
    source : str
        Python.

    Attributes
    ----------
    lines : list of str
        The source.
    beside : dict of int to str
        Comment at the end of a line of code, by line number.
    above : dict of int to str
        Comment lines directly above a line of code, by its number.
    """

    def __init__(self, source: str) -> None:
        self.lines = source.splitlines()
        self.beside: dict[int, str] = {}
        self.above: dict[int, str] = {}
        pending: list[str] = []
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                text = token.string.lstrip("# ")
                if text.startswith(("fmt:", "noqa")):
                    continue
                if token.line.lstrip().startswith("#"):
                    pending.append(text)
                else:
                    self.beside[token.start[0]] = text
            elif token.type == tokenize.NL and not token.line.strip():
                pending = []
            elif pending and token.type not in (tokenize.NL, tokenize.INDENT, tokenize.DEDENT):
                self.above[token.start[0]] = " ".join(pending)
                pending = []

    def remark(self, line: int) -> str:
        """Return the comment at the end of a line, for the end of one in C."""
        return f" /* {self.beside[line]} */" if line in self.beside else ""


def comment(text: str, indent: str = "") -> Iterator[str]:
    """Make text a C comment, on one line if it fits."""
    text = text.replace("\\|", "|").replace("*/", "* /")
    if "\n" not in text and len(indent) + len(text) + 6 <= WIDTH:
        yield f"{indent}/* {text} */"
        return
    lines = [
        line
        for paragraph in text.splitlines()
        for line in textwrap.wrap(
            paragraph, WIDTH - len(indent) - 3, subsequent_indent=_leading_space(paragraph)
        )
        or [""]
    ]
    yield f"{indent}/* {lines[0]}"
    for line in lines[1:]:
        yield f"{indent} * {line}".rstrip()
    yield f"{indent} */"


def docstring(node: ast.Module | ast.FunctionDef) -> str:
    """Return a docstring without its markup for code."""
    return (ast.get_docstring(node) or "").replace("`", "")


def _leading_space(line: str) -> str:
    return line[: len(line) - len(line.lstrip())]
