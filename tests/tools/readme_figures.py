"""The figures in README: tracking from runs over the bus (``make figures``), speed from ``make bench``."""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from dbc.contract import Contract
from hil.measure import result_of, trace_of
from hil.report import draw
from hil.run.inprocess import run_inprocess
from hil.run.options import RunOptions
from hil.scenario import load_scenario

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PICTURE = ROOT / "docs" / "sine.png"
BENCH = ROOT / "docs" / "bench.json"
SCENARIOS = ("sine", "sine_load", "lift_lower", "lift_lower_load")
CONTROLLERS = ("p", "pi", "adrc")


def table(picture: Path | None = None) -> str:
    """Return the figures as a Markdown table; draw the sine under ADRC to `picture`."""
    contract = Contract.load()
    lines = [
        "| scenario | controller | this project, RMS / max mm | paper, RMS / max mm |",
        "|---|---|---|---|",
    ]
    for name in SCENARIOS:
        scenario = load_scenario(name)
        for controller in CONTROLLERS:
            with tempfile.TemporaryDirectory() as directory:
                options = RunOptions(scenario, controller, record_directory=Path(directory))
                recording = run_inprocess(options)
            trace = trace_of(recording, contract)
            result = result_of(recording, trace, contract, options, "inprocess")
            ours, paper = (f"{f['rms_mm']:.3f} / {f['max_mm']:.3f}" for f in (result, result["paper"]))
            lines.append(f"| {name} | {controller.upper()} | {ours} | {paper} |")
            if picture is not None and (name, controller) == ("sine", "adrc"):
                draw(picture, result, trace)
    return "\n".join(lines) + "\n"


SPEED_ROWS = (  # figure of bench.json, what it is, unit, format
    ("inprocess_x", "all nodes in one process, over the bus", "x real time", ".1f"),
    ("lockstep_x", "three processes in lock-step, over the bus", "x real time", ".1f"),
    ("jitted_loop_x", "kernel and plant in one compiled loop, no bus", "x real time", ".0f"),
    ("adrc_step_sine_us", "one ADRC step, over the sine", "µs", ".3f"),
    ("adrc_step_worst_us", "one ADRC step, random inputs (all roots)", "µs", ".3f"),
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


def in_readme(block: str) -> str:
    """Return what README shows in the block of that name now."""
    begin, end = _marks(block)
    return README.read_text(encoding="utf-8").split(begin)[1].split(end)[0]


def write_to_readme(block: str, content: str) -> None:
    """Replace the block of that name."""
    begin, end = _marks(block)
    before, rest = README.read_text(encoding="utf-8").split(begin)
    README.write_text(before + begin + content + end + rest.split(end)[1], encoding="utf-8")


def _marks(block: str) -> tuple[str, str]:
    return f"<!-- {block}: begin -->\n", f"<!-- {block}: end -->\n"


def main() -> int:
    """Print the table, or write it and the picture into the project."""
    parser = argparse.ArgumentParser(description="Run all scenarios and print README's table of figures.")
    parser.add_argument("--write", action="store_true", help="rewrite README.md and docs/sine.png")
    if not parser.parse_args().write:
        print(table(), end="")
        return 0
    write_to_readme("figures", table(PICTURE))
    return 0


if __name__ == "__main__":
    sys.exit(main())
