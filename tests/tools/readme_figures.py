"""Figures in README and docs/studies.md: from ``hil reproduce`` (``make figures``) and ``make bench``."""

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from hil import cli
from hil.measure import METRICS

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
TABLES = ROOT / "docs" / "tables.json"
STUDIES = ROOT / "docs" / "studies.md"
PICTURE = ROOT / "docs" / "figure_6.png"
BENCH = ROOT / "docs" / "bench.json"
CHATTER = "chatter_rpm_per_period"


def table() -> str:
    """Return the errors in ``docs/tables.json`` as a Markdown table, the best of each row in bold."""
    tables = json.loads(TABLES.read_text(encoding="utf-8"))
    contestants, scenarios = tables["contestants"], tables["scenarios"]
    heads = [label + " †" * bool(one["fitted"]) for label, one in contestants.items()]
    rows = [["RMS / maximum error, mm", *heads], ["---"] * (len(heads) + 1)]
    for name, scenario in scenarios.items():
        papers = {one["law"]: label for label, one in contestants.items() if one["in_paper"]}
        theirs = {papers[law]: figures for law, figures in scenario["paper"].items()}
        rows.append([f"{name}, paper", *(_errors(theirs.get(label), {}) for label in contestants)])
        best = {metric: set(labels) for metric, labels in scenario["best"].items()}
        rows.append(
            [
                name,
                *(
                    _errors(figures, {metric for metric, labels in best.items() if label in labels})
                    for label, figures in scenario["ours"].items()
                ),
            ]
        )
    chatter = {label: figures[CHATTER] for label, figures in scenarios["sine"]["ours"].items()}
    rows.append([f"{METRICS[CHATTER][0]}, sine", *(f"{value:.1f}" for value in chatter.values())])
    robustness = tables["robustness"]
    failures = [one["failures"] for one in robustness["contestants"].values()]
    rows.append([f"failures of {robustness['samples']} other machines", *map(str, failures)])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _errors(figures: dict[str, Any] | None, bold: set[str]) -> str:
    if figures is None:
        return ""
    texts = {metric: f"{figures[metric]:.3f}" for metric in ("rms_mm", "max_mm")}
    return " / ".join(f"**{text}**" if metric in bold else text for metric, text in texts.items())


def stability_table() -> str:
    """Return in how many machines of the box each linear loop is unstable, and the nominal Ms."""
    tables = json.loads(TABLES.read_text(encoding="utf-8"))
    points = tables["stability"]
    corners = next(iter(points["held"].values()))["box"]["machines"]
    heads = (f"`{point}`: unstable of {corners} | nominal Ms" for point in points)
    lines = [f"| tuning, law | {' | '.join(heads)} |", "|---" * (1 + 2 * len(points)) + "|"]
    for label, one in tables["contestants"].items():
        cells = (_stability(by_label[label]) for by_label in points.values())
        lines.append(f"| {one['tuning']}, {one['law']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _stability(summary: dict[str, Any]) -> str:
    nominal = summary["nominal_and_corners"]
    ms, from_mm = nominal["first_ms"], nominal["first_unstable_from_mm"]
    shown = f"unstable, first at {from_mm:g} mm" if ms is None else f"{ms:.2f}"
    return f"{summary['box']['unstable_machines']} | {shown}"


def state_space_table() -> str:
    """Return how far each form of eq. (8) is from the plant."""
    forms = json.loads(TABLES.read_text(encoding="utf-8"))["state_space"]
    plants = next(iter(forms.values()))["errors_mm"]
    heads = (*(f"{plant}, RMS / max mm" for plant in plants), "gain at 0.2 m, m/rad", "mode at 0.15 m, Hz")
    lines = [f"| form | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|"]
    for form, one in forms.items():
        left = one["left_stroke_s"]
        until = "" if left is None else f" until it runs away at {left:.2f} s"
        errors = (f"{error['rms']:.2f} / {error['max']:.2f}{until}" for error in one["errors_mm"].values())
        others = f"{one['speed_gain_m_per_rad']:.2e} | {one['mode_hz']:.1f}"
        lines.append(f"| {form} | {' | '.join(errors)} | {others} |")
    return "\n".join(lines) + "\n"


SPEED_ROWS = (  # figure of bench.json, what it is, unit, format
    ("inprocess_x", "all nodes in one process, over the bus", "x real time", ".1f"),
    ("lockstep_x", "three processes in lock-step, over the bus", "x real time", ".1f"),
    ("jitted_loop_x", "kernel and plant in one compiled loop, no bus", "x real time", ".0f"),
    ("adrc_step_sine_us", "one ADRC step, over the sine", "µs", ".3f"),
    ("adrc_step_worst_us", "one ADRC step, random inputs (all powers)", "µs", ".3f"),
    ("pi_step_sine_us", "one PI step, over the sine", "µs", ".3f"),
    ("bare_late_p50_us", "lateness of a 1 ms timer, bare loop, median", "µs", ".1f"),
    ("bare_late_p99_us", "lateness of a 1 ms timer, bare loop, p99", "µs", ".1f"),
    ("engine_late_p50_us", "lateness of a 1 ms timer, real-time mode, median", "µs", ".1f"),
    ("engine_late_p99_us", "lateness of a 1 ms timer, real-time mode, p99", "µs", ".1f"),
    ("engine_late_p99_ratio", "p99 of the real-time mode over the bare loop's", "x", ".2f"),
    ("python_loop_ms", "a plain Python loop, to compare machines by", "ms", ".1f"),
)


def speed_table() -> str:
    """Return what the last ``make bench`` measured as a Markdown table."""
    bench = json.loads(BENCH.read_text(encoding="utf-8"))
    lines = ["| what | median | range | |", "|---|---|---|---|"]
    for name, label, unit, form in SPEED_ROWS:
        figure = bench["figures"].get(name)
        if figure is None:  # newer than the last bench
            continue
        spread = f"{figure['min']:{form}} to {figure['max']:{form}}"
        lines.append(f"| {label} | {figure['median']:{form}} | {spread} | {unit} |")
    machine = bench["machine"]
    rounds, python = bench["rounds"], machine["python"]
    lines += ["", f"{rounds} interleaved rounds on {machine['cores']} shared cores, Python {python}."]
    return "\n".join(lines) + "\n"


def in_page(block: str, page: Path = README) -> str:
    """Return what a page shows in the block of that name now."""
    begin, end = _marks(block)
    return page.read_text(encoding="utf-8").split(begin)[1].split(end)[0]


def write_to_page(block: str, content: str, page: Path = README) -> None:
    """Replace the block of that name."""
    begin, end = _marks(block)
    before, rest = page.read_text(encoding="utf-8").split(begin)
    page.write_text(before + begin + content + end + rest.split(end)[1], encoding="utf-8")


def _marks(block: str) -> tuple[str, str]:
    return f"<!-- {block}: begin -->\n", f"<!-- {block}: end -->\n"


def main() -> int:
    """Print the table, or evaluate anew and write it, its figures and the picture into the project."""
    parser = argparse.ArgumentParser(description="Print README's table of figures.")
    parser.add_argument("--write", action="store_true", help="evaluate; rewrite README.md and docs/")
    if not parser.parse_args().write:
        print(table(), end="")
        return 0
    out = ROOT / "out" / "reproduce"
    if code := cli.main(["reproduce", "--out", str(out)]):
        return code
    for file in (TABLES, PICTURE):
        shutil.copy(out / file.name, file)
    write_to_page("figures", table())
    write_to_page("stability", stability_table(), STUDIES)
    write_to_page("state space", state_space_table(), STUDIES)
    return 0


if __name__ == "__main__":
    sys.exit(main())
