"""What a node writes down of itself, one row per period, for the bench to merge by time."""

from pathlib import Path
from typing import Any

import numpy as np

_ROWS = 1 << 12


class Record:
    """Rows of numbers under fixed column names; the first column is `time_ns` on the node's own clock.

    Compiled code appends for itself: it fills row `count[0]` of `rows`, then adds one to the count.

    Parameters
    ----------
    columns : tuple of str
        Column names with their units.
    dtype : type
        `np.float64` or, for integers only, `np.int64`.

    Attributes
    ----------
    rows : ndarray, shape (room, len(columns))
        The rows so far, and room for more; another array after an `append` that found none.
    count : ndarray of int64, shape (1,)
        Number of rows so far.
    """

    def __init__(self, columns: tuple[str, ...], dtype: type[np.generic]) -> None:
        self.columns = columns
        self.rows = np.empty((_ROWS, len(columns)), dtype)
        self.count = np.zeros(1, np.int64)

    def append(self, row: np.ndarray | tuple[float, ...]) -> None:
        """Append a row; make room for more if there is none."""
        if self.count[0] == len(self.rows):
            self.rows = np.concatenate([self.rows, np.empty_like(self.rows)])
        self.rows[self.count[0]] = row
        self.count[0] += 1

    def clear(self) -> None:
        """Forget all rows."""
        self.count[0] = 0

    def amend(self, column: str, value: float) -> None:
        """Change a cell of the last row; do nothing before the first one."""
        if self.count[0]:
            self.rows[self.count[0] - 1, self.columns.index(column)] = value

    def columns_by_name(self) -> dict[str, np.ndarray]:
        """Return each column as an array of the number of rows."""
        table = self.rows[: self.count[0]].copy()  # another thread may be appending
        return dict(zip(self.columns, table.T, strict=True))

    def save(self, path: Path) -> None:
        """Write the columns to an `.npz` file, whole or not at all."""
        columns: dict[str, Any] = self.columns_by_name()
        unfinished = path.with_suffix(".unfinished.npz")
        np.savez(unfinished, **columns)
        unfinished.replace(path)
