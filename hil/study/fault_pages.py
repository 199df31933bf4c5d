"""The fault matrix that was played, for people: a table in Markdown, a page of HTML, a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.picture import BLUE, GREY, ORANGE
from hil.study.fault_matrix import PHASES, Detector, Reaction
from hil.study.fault_runs import Played
from hil.study.html_page import render

REACTIONS = {
    Reaction.SAFE: "safe state, quick stop",
    Reaction.DRIVE_STOP: "drive stops itself, then safe state",
    Reaction.STANDBY: "stop, standby",
    Reaction.TOLERATED: "tolerated",
    Reaction.UNDETECTED: "undetected",
}


def markdown(matrix: Mapping[str, Any]) -> str:
    """Return the matrix as Markdown tables, one for each group of faults.

    Parameters
    ----------
    matrix : mapping
        As written to ``matrix.json``.
    """
    blocks = []
    for group, faults in grouped(matrix).items():
        lines = [f"**{group.capitalize()}**", ""]
        lines.append(f"| fault | noticed by | reaction | {' | '.join(p.title for p in PHASES.values())} |")
        lines.append("|---" * (3 + len(PHASES)) + "|")
        lines += [
            f"| `{name.replace(',', ', ')}` | {noticed(cases)} | {reaction(cases)} | "
            f"{' | '.join(cell(case) for case in cases)} |"
            for name, cases in faults.items()
        ]
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def page(matrix: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """Return the matrix as a page of HTML that needs nothing but itself.

    Parameters
    ----------
    matrix : mapping
        As written to ``matrix.json``.
    pictures : mapping of Path
        SVG files by name; empty if none was drawn.
    """
    return render(
        "faults.html",
        pictures,
        matrix=matrix,
        groups=grouped(matrix),
        phases=PHASES,
        noticed=noticed,
        reaction=reaction,
        cell=cell,
    )


def grouped(matrix: Mapping[str, Any]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return the cases by group and fault."""
    groups: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for case in matrix["cases"]:
        groups.setdefault(case["group"], {}).setdefault(case["fault"], []).append(case)
    return groups


def noticed(cases: Sequence[Mapping[str, Any]]) -> str:
    """Return who notices a fault in the first phase but standby, when at the latest, and when it should."""
    running = [case for case in cases if case["phase"] != "standby"] or cases
    by = running[0]["measured"]["by"]
    if by == Detector.NOBODY:
        return str(by)
    latest_ms = max(case["measured"]["detected_ms"] or 0.0 for case in running)
    return f"{by}, {latest_ms:.1f} of {running[0]['expected']['within_ms']:g} ms"


def reaction(cases: Sequence[Mapping[str, Any]]) -> str:
    """Return the reaction that is expected in the first phase but standby, in words."""
    running = [case for case in cases if case["phase"] != "standby"]
    if not running:
        return "nothing moves"
    return REACTIONS[Reaction(running[0]["expected"]["reaction"])]


def cell(case: Mapping[str, Any]) -> str:
    """Return what was measured in one phase, in words."""
    measured, expected = case["measured"], case["expected"]
    if not case["as_expected"]:
        return f"NOT AS EXPECTED: {'; '.join(case['complaints'])}"
    if case["phase"] == "standby":
        return "stays"
    if Reaction(expected["reaction"]).stops:
        if measured["at_rest_ms"] == 0.0:
            return "was at rest"
        return f"at rest in {measured['at_rest_ms']:.0f} of {case['allowed_stop_ms']:.1f} ms"
    if expected["reaction"] == Reaction.UNDETECTED:
        return f"off by {measured['end_effect_mm']:.1f} mm"
    return f"error {measured['error_mm']:.2f} mm"


def draw(path: Path, played: Sequence[Played]) -> None:
    """Draw the course of the cases that kept theirs: position and motor speed over time from the fault on."""
    import matplotlib  # 0.3 s, which only drawing should cost

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "faults"  # the same picture from the same run
    from matplotlib import pyplot

    columns = min(3, len(played))
    rows = -(-len(played) // columns)
    picture, axes = pyplot.subplots(
        2 * rows,
        columns,
        figsize=(4.0 * columns, 3.6 * rows),
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for index, one in enumerate(played):
        row, column = divmod(index, columns)
        position, speed = axes[2 * row, column], axes[2 * row + 1, column]
        time_ms = one.course["time_s"] * 1e3
        position.set_title(f"{PHASES[one.case.phase].title}:\n{one.case.name}", fontsize="small")
        position.plot(time_ms, one.course["reference_m"] * 1e3, color=GREY, lw=2.5, label="reference")
        position.plot(time_ms, one.course["position_m"] * 1e3, color=BLUE, lw=1.2, label="position")
        speed.plot(time_ms, one.course["motor_speed_rpm"], color=ORANGE, lw=1.0, label="motor speed")
        for axis in (position, speed):
            axis.axvline(0.0, color=GREY, lw=0.8, ls="--")
            axis.grid(alpha=0.3)
        if index == 0:
            position.legend(fontsize="small")
            speed.legend(fontsize="small")
        if column == 0:
            position.set_ylabel("position / mm")
            speed.set_ylabel("motor speed / rpm")
    for unused in range(len(played), rows * columns):
        row, column = divmod(unused, columns)
        axes[2 * row, column].remove()
        axes[2 * row + 1, column].remove()
    for lowest in range(max(0, len(played) - columns), len(played)):
        axis = axes[2 * (lowest // columns) + 1, lowest % columns]
        axis.set_xlabel("time from the fault / ms")
        axis.tick_params(labelbottom=True)
    picture.savefig(path, metadata={"Date": None})
    pyplot.close(picture)
