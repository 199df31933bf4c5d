"""The picture of a run: what was commanded, what came of it, and what went wrong when."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from firmware_py.chosen_firmware import PYTHON
from hil.faults.fault import text_of
from hil.measure import M_TO_MM, Trace
from plant_sim.machine import Machine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREY, RED = "#0b5394", "#d9730d", "#8a8a8a", "#b02a30"

_WIDTH_IN = 9.0
_PANEL_IN = 2.3
_NUMBER_SHARE = 0.05
"""Of the time axis: faults nearer to one another share a label, as their numbers would overlap."""
_FAULTS_LISTED = 12
_LINE_LETTERS = 110


def heading(result: dict[str, Any]) -> str:
    """Return what was played: scenario, law, tuning, firmware, machine and mode, from a run's `result`."""
    firmware, machine = result["firmware"], result["machine"]
    whose = f"{result['controller']} ({result['tuning'] or 'started elsewhere'})"
    if firmware is not None and firmware["name"] != PYTHON:
        whose += f" on {firmware['name']}"
    plant = "plant started elsewhere"
    if machine is not None:
        changes = Machine(**machine).changes
        plant = f"machine {changes}" if changes else "nominal machine"
    return f"{result['scenario']}, {whose}, {plant}, {result['mode']}"


def draw(path: Path, result: dict[str, Any], trace: Trace) -> None:
    """Draw a run and save it."""
    figure_of(result, trace).savefig(path, dpi=110)


def figure_of(result: dict[str, Any], trace: Trace) -> "Figure":
    """Return position, error, motor speed, load if there is one, and ADRC's observed disturbance over time.

    Each fault has a line and a number, which the list below explains.
    """
    from matplotlib.figure import Figure  # 0.3 s, which only drawing should cost

    panels: list[tuple[str, list[tuple[str, str, float, str, float]]]] = [
        (
            "position / mm",
            [
                ("reference_m", "reference", M_TO_MM, GREY, 3.0),
                ("position_m", "position", M_TO_MM, BLUE, 1.2),
            ],
        ),
        ("error / mm", [("error_m", "reference - position", M_TO_MM, RED, 0.9)]),
        (
            "motor speed / rpm",
            [
                ("motor_speed_rpm", "motor", 1.0, GREY, 2.5),
                ("target_velocity_rpm", "commanded", 1.0, ORANGE, 0.9),
            ],
        ),
    ]
    if np.any(np.nan_to_num(trace.get("load_n", np.zeros(1)))):
        panels.append(("load force / N", [("load_n", "on the rod, positive resists", 1.0, BLUE, 1.2)]))
    if result["controller"] == "adrc" and "eso_disturbance_m_s3" in trace:
        observed = ("eso_disturbance_m_s3", "observed by the ESO, z4", 1.0, ORANGE, 0.9)
        panels.append(("total disturbance / (m/s³)", [observed]))

    figure = Figure(figsize=(_WIDTH_IN, 1.2 + _PANEL_IN * len(panels)), layout="constrained")
    figure.suptitle("\n".join(_title(result)), fontsize="medium")
    all_axes = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, lines) in zip(all_axes, panels, strict=True):
        for column, what, factor, colour, width in lines:
            if column in trace:
                axes.plot(trace["time_s"], trace[column] * factor, color=colour, lw=width, label=what)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
        axes.legend(loc="best", fontsize="small")
    all_axes[-1].set_xlabel("time / s")
    _mark_faults(figure, all_axes, sorted(result["faults"], key=lambda fault: fault["at_s"]))
    return figure


def _title(result: dict[str, Any]) -> list[str]:
    played = f"{heading(result)}, CAN at {result['bit_rate'] / 1e6:g} Mbit/s"
    lines = wrap(played, _LINE_LETTERS, break_on_hyphens=False)
    paper = result["paper"]
    if result["max_mm"] is not None:
        errors = f"error: RMS {result['rms_mm']:.3f} mm, maximum {result['max_mm']:.3f} mm"
        lines.append(errors + (f" (paper: {paper['rms_mm']:.3f}, {paper['max_mm']:.3f} mm)" if paper else ""))
    return lines + wrap(result.get("verdict") or result["ending"], _LINE_LETTERS)


def _mark_faults(figure: "Figure", all_axes: Sequence["Axes"], faults: list[dict[str, Any]]) -> None:
    """Draw a line where a fault begins, its number above it, and list below what the numbers mean."""
    if not faults:
        return
    for fault in faults:
        for axes in all_axes:
            axes.axvline(fault["at_s"], color=RED, lw=0.8, ls=":")
    low_s, high_s = all_axes[0].get_xlim()
    groups: list[list[int]] = []
    for number, fault in enumerate(faults, start=1):
        if groups and fault["at_s"] - faults[groups[-1][0] - 1]["at_s"] < _NUMBER_SHARE * (high_s - low_s):
            groups[-1].append(number)
        else:
            groups.append([number])
    for group in groups:
        first, last = group[0], group[-1]
        all_axes[0].annotate(
            f"{first}" if first == last else f"{first}-{last}",
            (faults[first - 1]["at_s"], 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize="small",
            color=RED,
        )
    listed = [f"{number}: {text_of(fault)}" for number, fault in enumerate(faults, start=1)]
    if more := listed[_FAULTS_LISTED:]:
        listed = [*listed[:_FAULTS_LISTED], f"and {len(more)} more, in result.json"]
    figure.supxlabel("\n".join(listed), x=0.01, ha="left", fontsize="small", color=RED)
