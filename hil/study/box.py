"""A box of machines: closed ranges of what may differ, its corners and seeded samples of it."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import resources
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

from plant_sim.machine import Machine
from plant_sim.parameters import ParameterError

WHOLE = frozenset(item.name for item in fields(Machine) if item.type is int)
"""Keys whose values are whole numbers."""


class BoxError(ValueError):
    """A box that is empty, inverted or has a key that no machine has; one line."""


@dataclass(frozen=True, slots=True)
class Box:
    """Ranges of some of a machine's keys; the others keep their value.

    Parameters
    ----------
    ranges : mapping of str to (float, float)
        Smallest and largest value, both included, by key of `plant_sim.machine.Machine`.

    Raises
    ------
    BoxError
        If there is no range, or one that is inverted or reaches beyond what a machine may have.
    """

    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        if not self.ranges:
            allowed = ", ".join(item.name for item in fields(Machine))
            raise BoxError(f"box: it is empty; give KEY = [LOWEST, HIGHEST] for some of {allowed}")
        checked = {key: self._checked(key, value) for key, value in self.ranges.items()}
        object.__setattr__(self, "ranges", MappingProxyType(checked))

    def corners(self, base: Machine = Machine()) -> list[Machine]:  # noqa: B008 - frozen
        """Return the machines at the box's corners, 2 to the number of ranges of them.

        Parameters
        ----------
        base : Machine
            Has the values of the keys that the box does not name.
        """
        values = product(*(sorted(set(ends)) for ends in self.ranges.values()))
        return [base.with_changes(dict(zip(self.ranges, corner, strict=True))) for corner in values]

    def samples(self, count: int, seed: int = 0, base: Machine = Machine()) -> list[Machine]:  # noqa: B008
        """Return machines from a Latin hypercube over the box; equal seeds give equal machines.

        Parameters
        ----------
        count : int
            How many, at least 1.
        seed : int
            Of the hypercube, not negative.
        base : Machine
            As for `corners`.
        """
        from scipy.stats import qmc  # half a second, which only sampling should cost

        unit = qmc.LatinHypercube(len(self.ranges), rng=seed).random(count)
        return [
            base.with_changes({key: self._inside(key, u) for key, u in zip(self.ranges, row, strict=True)})
            for row in unit.tolist()
        ]

    def _inside(self, key: str, share: float) -> float:
        """Return the value a share, from 0 to below 1, of the way; whole numbers get equal parts."""
        low, high = self.ranges[key]
        if key in WHOLE:
            return low + int(share * (high - low + 1))
        return low + share * (high - low)

    @staticmethod
    def _checked(key: str, ends: Any) -> tuple[float, float]:
        if not isinstance(ends, list | tuple) or len(ends) != 2:
            raise BoxError(f"box: {key} is {ends!r}, must be [LOWEST, HIGHEST]")
        try:
            low, high = (getattr(Machine.from_table({key: end}), key) for end in ends)
        except ParameterError as error:
            raise BoxError(f"box: {str(error).removeprefix('machine: ')}") from error
        if low > high:
            raise BoxError(f"box: {key} is [{low!r}, {high!r}], which is inverted")
        return low, high


def load_box(file: Path | None = None) -> Box:
    """Return the box a TOML file describes, by default the one in the package.

    Raises
    ------
    BoxError
        If it cannot be read, or is not a box.
    """
    source = resources.files("hil.study").joinpath("box.toml") if file is None else file
    try:
        table = tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise BoxError(f"box: cannot read {file} ({error.strerror})") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BoxError(f"box: {file}: {error}") from error
    return Box(table)
