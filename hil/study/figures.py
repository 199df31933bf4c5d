"""The evaluation's figures. Imports matplotlib; import it only where something is drawn."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from hil.measure import M_TO_MM, METRICS, Trace
from hil.study.evaluation import OBSERVED, TRUE

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = (  # Okabe and Ito, told apart by the colour-blind
    "#000000",
    "#e69f00",
    "#56b4e9",
    "#009e73",
    "#0072b2",
    "#d55e00",
    "#cc79a7",
)
GREY = "#9a9a9a"
_COLOURS = {
    "P": PURPLE,
    "PI": ORANGE,
    "ADRC": BLUE,
    "PI*": GREEN,
    "PI+FF": BLACK,
    "linear ADRC": SKY,
    "robust ADRC": VERMILION,
}
_MORE_COLOURS = (GREY, "#5d3a9b", "#7f6000", "#994f00")
MAPPED_POINT = "held"
"""Operating point with a heat map."""

_DRAWN_BINS = 900
_WIDTH_IN = 8.5
_PANEL_IN = 1.7

Draw = Callable[[Figure], None]

_SETTINGS: dict[Any, Any] = {
    "svg.hashsalt": "hil",
    "svg.fonttype": "none",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.xmargin": 0.01,
    "lines.linewidth": 1.1,
    "figure.constrained_layout.w_pad": 0.1,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


def save(directory: Path, name: str, draw: Draw) -> list[Path]:
    """Draw a figure and write it as SVG and PNG, the same bytes for the same content."""
    with matplotlib.rc_context(_SETTINGS):
        figure = Figure(layout="constrained")
        draw(figure)
        paths = [directory / f"{name}.svg", directory / f"{name}.png"]
        figure.savefig(paths[0], metadata={"Date": None, "Creator": None})
        figure.set_layout_engine("none")  # it is laid out: not again
        figure.savefig(paths[1], dpi=130, metadata={"Software": None})
    return paths


def colours(labels: Iterable[str]) -> dict[str, str]:
    """Return a colour for each contestant, by label."""
    others = (label for label in labels if label not in _COLOURS)
    return _COLOURS | dict(zip(others, cycle(_MORE_COLOURS), strict=False))


def tracking(traces: Mapping[str, Trace]) -> Draw:
    """Return what draws the paper's Figure 5, 6, 7 or 8 from our traces of P, PI and ADRC.

    Load if there is one, position, error, ADRC's error enlarged, total disturbance observed and true, and the
    difference of these two.
    """
    adrc = traces["ADRC"]
    time_s = adrc["time_s"]

    def load(axes: Axes) -> None:
        axes.plot(time_s, adrc["load_n"], color=BLACK, drawstyle="steps-post")
        axes.set_ylabel("load force / N")

    def position(axes: Axes) -> None:
        axes.plot(time_s, adrc["reference_m"] * M_TO_MM, color=BLACK, lw=3.0, alpha=0.25, label="reference")
        for label, trace in traces.items():
            _line(axes, trace, trace["position_m"] * M_TO_MM, label)
        axes.set_ylabel("position / mm")
        _legend(axes)

    def error(axes: Axes) -> None:
        for label, trace in traces.items():
            _line(axes, trace, trace["error_m"] * M_TO_MM, label)
        axes.set_ylabel("error / mm")
        _legend(axes)

    def adrc_error(axes: Axes) -> None:
        _line(axes, adrc, adrc["error_m"] * M_TO_MM, "ADRC")
        axes.set_ylabel("error / mm")
        _legend(axes)

    def disturbance(axes: Axes) -> None:
        _line(axes, adrc, adrc[TRUE] * 1e-3, "true, from the plant's equations", BLACK, lw=0.9)
        _line(axes, adrc, adrc[OBSERVED] * 1e-3, "observed, z4", VERMILION)
        axes.set_ylabel("disturbance / (km/s³)")
        _legend(axes)

    def difference(axes: Axes) -> None:
        _line(axes, adrc, (adrc[OBSERVED] - adrc[TRUE]) * 1e-3, "observed - true", GREY, lw=0.9)
        axes.set_ylabel("difference / (km/s³)")
        _legend(axes)

    panels = [position, error, adrc_error, disturbance, difference]
    if np.any(adrc["load_n"]):
        panels.insert(0, load)
    return _stacked(panels)


def rivals(traces: Mapping[str, Mapping[str, Trace]]) -> Draw:
    """Return what draws the error of all contestants but P and PI, a panel for each scenario.

    Parameters
    ----------
    traces : mapping of mapping of Trace
        By scenario and label.
    """

    def panel_of(name: str) -> Callable[[Axes], None]:
        def panel(axes: Axes) -> None:
            colour = colours(traces[name])
            for label, trace in traces[name].items():
                if label not in ("P", "PI"):
                    _line(axes, trace, trace["error_m"] * M_TO_MM, label, colour[label], lw=0.9)
            axes.set_ylabel("error / mm")
            axes.set_title(name, loc="left", fontsize=9)
            if name == next(iter(traces)):
                _legend(axes)

        return panel

    return _stacked([panel_of(name) for name in traces], lettered=False)


def comparison(tables: Mapping[str, Any]) -> Draw:
    """Return what draws RMS and maximum error of all contestants beside the paper's, on a log scale."""
    contestants = tables["contestants"]
    colour = colours(contestants)
    scenarios = tables["scenarios"]

    def draw(figure: Figure) -> None:
        figure.set_size_inches(_WIDTH_IN, 0.9 + 0.9 * len(scenarios))
        for axes, metric in zip(figure.subplots(1, 2, sharey=True), ("rms_mm", "max_mm"), strict=True):
            for row, (label, one) in enumerate(contestants.items()):
                offset = (row - (len(contestants) - 1) / 2) * 0.8 / len(contestants)
                y = np.arange(len(scenarios)) + offset
                ours = [table["ours"][label][metric] for table in scenarios.values()]
                axes.plot(ours, y, "o", color=colour[label], ms=5, label=label)
                if one["in_paper"]:
                    theirs = [table["paper"][one["law"]][metric] for table in scenarios.values()]
                    axes.plot(theirs, y, "D", color=colour[label], mfc="none", ms=5)
            axes.plot([], [], "D", color=BLACK, mfc="none", ms=5, label="paper")
            axes.set_xscale("log")
            axes.margins(x=0.05)
            axes.set_xlabel(METRICS[metric][0])
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yticks(np.arange(len(scenarios)), list(scenarios))
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=8)

    return draw


def _stacked(panels: Sequence[Callable[[Axes], None]], lettered: bool = True) -> Draw:
    """Return what draws panels over one time axis, lettered (a), (b), ... as the paper's."""

    def draw(figure: Figure) -> None:
        figure.set_size_inches(_WIDTH_IN, 0.4 + _PANEL_IN * len(panels))
        all_axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for letter, axes, panel in zip("abcdefgh", all_axes, panels, strict=False):
            panel(axes)
            if lettered:
                axes.set_title(f"({letter})", loc="left", fontsize=9)
        all_axes[-1].set_xlabel("time / s")

    return draw


def _line(axes: Axes, trace: Trace, values: np.ndarray, label: str, colour: str = "", **style: Any) -> None:
    time_s, drawn = _thinned(trace["time_s"], values)
    axes.plot(time_s, drawn, color=colour or _COLOURS[label], label=label, **style)


def _thinned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return smallest and largest value of each of `_DRAWN_BINS` bins, in order: what a screen can show."""
    if len(x) <= 2 * _DRAWN_BINS:
        return x, y
    bins = np.array_split(np.arange(len(x)), _DRAWN_BINS)
    kept = np.concatenate([np.unique([part[np.argmin(y[part])], part[np.argmax(y[part])]]) for part in bins])
    return x[kept], y[kept]


def _legend(axes: Axes) -> None:
    """Put the legend above the panel, beside its letter."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=8, borderaxespad=0.0, handlelength=1.5)
