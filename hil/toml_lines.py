"""On which line of a TOML text a key is: `tomllib` does not tell."""

import tomllib
from typing import Any

KeyPath = tuple[str | int, ...]
"""Keys, and indices into arrays of tables, from the top of the text down."""


def line_of(text: str, path: KeyPath) -> int | None:
    """Return the line (1, 2, ...) on which a key, table or element of an array of tables begins.

    None if it is not in the text. A text cut after the key's value has the key, one cut before has not, and
    one cut in the middle of a value is no TOML.
    """
    lines = text.splitlines(keepends=True)
    begin = 1
    for count in range(1, len(lines) + 1):
        try:
            content = tomllib.loads("".join(lines[:count]))
        except tomllib.TOMLDecodeError:
            continue
        if _has(content, path):
            return begin
        begin = count + 1
    return None


def _has(content: Any, path: KeyPath) -> bool:
    for key in path:
        try:
            content = content[key]
        except (KeyError, IndexError, TypeError):
            return False
    return True
