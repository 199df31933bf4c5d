"""What a node writes down of itself, one row per period, for the bench to merge by time."""

from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


class Record:
    """Rows of numbers under fixed column names; the first column is `time_ns` on the node's own clock.

    Parameters
    ----------
    columns : tuple of str
        Column names with their units.
    typecode : str
        `array.array` type: ``"d"`` or, for integers only, ``"q"``.
    """

    def __init__(self, columns: tuple[str, ...], typecode: str) -> None:
        self.columns = columns
        self._cells: array[Any] = array(typecode)
        self.append: Callable[[tuple[float, ...]], None] = self._cells.extend

    def append_array(self, row: np.ndarray) -> None:
        """Append a row of the record's own type."""
        self._cells.frombytes(row.tobytes())

    def clear(self) -> None:
        """Forget all rows."""
        del self._cells[:]

    def amend(self, column: str, value: float) -> None:
        """Change a cell of the last row; do nothing before the first one."""
        if self._cells:
            self._cells[self.columns.index(column) - len(self.columns)] = value

    def columns_by_name(self) -> dict[str, np.ndarray]:
        """Return each column as an array of the number of rows."""
        cells = self._cells.tobytes()  # in one step: another thread may be appending
        table = np.frombuffer(cells, self._cells.typecode).reshape(-1, len(self.columns))
        return dict(zip(self.columns, table.T, strict=True))

    def save(self, path: Path) -> None:
        """Write the columns to an `.npz` file, whole or not at all."""
        columns: dict[str, Any] = self.columns_by_name()
        unfinished = path.with_suffix(".unfinished.npz")
        np.savez(unfinished, **columns)
        unfinished.replace(path)
