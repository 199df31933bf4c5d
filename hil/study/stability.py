"""Stability of the linear loop (`hil.study.linear`) over stroke and machines: data, verdict, heat map."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from firmware_py.tuning import Tuning
from hil.study.box import Box
from hil.study.linear import (
    OPERATING_POINTS,
    LinearLoop,
    StateSpace,
    controller_model,
    driven_plant,
    linear_loop,
)
from plant_sim.drive import MAX_DELAY_PERIODS
from plant_sim.machine import Machine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

POSITIONS_M = np.array([0.3, 1, 3, 10, *range(20, 381, 20), 385, 390, 395]) * 1e-3
"""Denser where a chamber is small: a grid that ends at 370 mm has hidden an unstable design."""

_MAP_BOX = Box({"bulk_modulus": (0.3, 1.5), "mass": (0.5, 1.5), "efficiency": (0.7, 0.95)})
_NOMINAL = asdict(Machine())
_NOT_LINEAR = {key: _NOMINAL[key] for key in ("motor_acceleration_rad_s2", "position_lsb_um")}
_DRIVE = {key: _NOMINAL[key] for key in ("motor_time_constant_s", "delay_periods")}
_WORDS = {
    "bulk_modulus": "oil ×{:g}",
    "mass": "mass ×{:g}",
    "leak": "leak ×{:g}",
    "efficiency": "η {:.2f}",
    "motor_time_constant_s": "motor {:g} s",
}
_MS_SHOWN = (1.0, 4.0)
_RADIUS_SHOWN = (0.97, 1.0)
_TICKS_MM = (0.3, 40, 100, 200, 300, 395)
_WIDTH_IN = 8.5
_ROW_IN = 0.115


def map_machines() -> list[Machine]:
    """Return the nominal machine and the corners of oil stiffness, mass and η, with 1, 2, 3 periods."""
    delays = range(1, MAX_DELAY_PERIODS + 1)
    nominal = [Machine(delay_periods=delay) for delay in delays]
    return nominal + [
        machine for delay in delays for machine in _MAP_BOX.corners(Machine(delay_periods=delay))
    ]


@dataclass(frozen=True, slots=True, eq=False)
class StabilityMap:
    """Linear loops of one tuning with many machines along the stroke.

    Attributes
    ----------
    machines : sequence of Machine
    positions_m : ndarray
    loop : LinearLoop
        Arrays of shape (machines, positions).
    """

    machines: Sequence[Machine]
    positions_m: np.ndarray
    loop: LinearLoop

    def summary(self) -> dict[str, Any]:
        """Return the worst cases as plain numbers.

        Returns
        -------
        summary : dict
            ``machines``, and how many of them are somewhere unstable, ``unstable_machines``;
            ``largest_spectral_radius`` and ``largest_ms`` (None where unstable), each with its ``..._at_mm``
            and ``..._machine``; of the first machine ``first_ms``, its largest (None if somewhere
            unstable), and ``first_unstable_from_mm``, the first position where it is (None if nowhere).
        """
        radius, ms = self.loop.spectral_radius, self.loop.ms
        first_unstable_mm = (self.positions_m[~self.loop.stable[0]] * 1e3).tolist()
        return {
            "machines": len(self.machines),
            "unstable_machines": int((~self.loop.stable).any(axis=1).sum()),
            **self._worst("largest_spectral_radius", radius),
            **self._worst("largest_ms", ms),
            "first_ms": _finite(ms[0].max()),
            "first_unstable_from_mm": first_unstable_mm[0] if first_unstable_mm else None,
        }

    def _worst(self, name: str, values: np.ndarray) -> dict[str, Any]:
        row, column = divmod(int(np.argmax(values)), values.shape[1])
        return {
            name: _finite(values[row, column]),
            f"{name}_at_mm": float(self.positions_m[column]) * 1e3,
            f"{name}_machine": describe(self.machines[row]),
        }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def stability_maps(
    tunings: Mapping[str, tuple[Tuning, int | None]],
    machines: Sequence[Machine],
    positions_m: np.ndarray = POSITIONS_M,
    point: str = "held",
) -> dict[str, StabilityMap]:
    """Analyse the linear loops of several tunings with each machine at each position.

    Parameters
    ----------
    tunings : mapping of str to (Tuning, int or None)
        By label: the tuning, and the control law if it is not the tuning's own.
    machines : sequence of Machine
        Those that differ only in what does not enter a linear loop are analysed once: 64 of a box's 256
        corners are left.
    positions_m : ndarray
        Rod positions, off the stops.
    point : str
        One of `hil.study.linear.OPERATING_POINTS`.

    Returns
    -------
    maps : dict of StabilityMap
        By label.
    """
    rows = [replace(machine, **_NOT_LINEAR) for machine in machines]
    distinct = list(dict.fromkeys(rows))
    positions = positions_m.tolist()
    linearised = {
        hydraulics: [OPERATING_POINTS[point](hydraulics.parameters, x) for x in positions]
        for hydraulics in {replace(machine, **_DRIVE) for machine in distinct}
    }
    plants = StateSpace.stacked(
        [
            StateSpace.stacked(
                [driven_plant(a, b, machine) for a, b in linearised[replace(machine, **_DRIVE)]]
            )
            for machine in distinct
        ]
    )
    row_of = [distinct.index(machine) for machine in rows]
    maps = {}
    for label, (tuning, law) in tunings.items():
        controllers = StateSpace.stacked([controller_model(tuning, x, law) for x in positions])
        loop = linear_loop(plants, controllers)
        loop = LinearLoop(loop.eigenvalues[row_of], loop.spectral_radius[row_of], loop.ms[row_of])
        maps[label] = StabilityMap(machines, positions_m, loop)
    return maps


def describe(machine: Machine) -> str:
    """Return what a machine differs in from the nominal one, in words."""
    values = asdict(machine)
    words = [form.format(values[key]) for key, form in _WORDS.items() if values[key] != _NOMINAL[key]]
    periods = f"{machine.delay_periods} period{'s' if machine.delay_periods > 1 else ''}"
    return ", ".join([*(words or ["nominal"]), periods])


def heat_map(maps: Mapping[str, StabilityMap]) -> Callable[["Figure"], None]:
    """Return what draws spectral radius and Ms over stroke and machines, a row of two panels for each map."""

    def draw(figure: "Figure") -> None:
        rows = max(len(one.machines) for one in maps.values())
        figure.set_size_inches(_WIDTH_IN, len(maps) * (0.6 + _ROW_IN * rows))
        panels = figure.subplots(len(maps), 2, squeeze=False, sharex=True)
        for axes_pair, (label, one) in zip(panels, maps.items(), strict=True):
            images = (
                _panel(axes_pair[0], one, one.loop.spectral_radius, _RADIUS_SHOWN),
                _panel(axes_pair[1], one, one.loop.ms, _MS_SHOWN),
            )
            axes_pair[0].set_title(f"{label}: spectral radius", loc="left")
            axes_pair[1].set_title(f"{label}: peak of sensitivity Ms", loc="left")
            axes_pair[0].set_yticks(range(len(one.machines)), [describe(machine) for machine in one.machines])
            axes_pair[1].set_yticks([])
        for column, image in enumerate(images):
            figure.colorbar(image, ax=panels[:, column], location="top", extend="both", aspect=40, pad=0.005)
        for axes in panels[-1]:
            axes.set_xlabel("position / mm (× unstable)")

    return draw


def _panel(axes: "Axes", shown: StabilityMap, values: np.ndarray, span: tuple[float, float]) -> "AxesImage":
    """Draw one quantity, brighter being nearer to instability, and a cross on each unstable cell."""
    image = axes.imshow(values, aspect="auto", cmap="cividis", vmin=span[0], vmax=span[1])
    row, column = np.nonzero(~shown.loop.stable)
    axes.plot(column, row, "x", color="#d55e00", markersize=3.0)
    ticks = [int(np.argmin(np.abs(shown.positions_m - at_mm * 1e-3))) for at_mm in _TICKS_MM]
    axes.set_xticks(ticks, [f"{shown.positions_m[tick] * 1e3:g}" for tick in ticks])
    axes.tick_params(axis="y", labelsize=7.0, length=0.0)
    axes.grid(visible=False)
    return image
