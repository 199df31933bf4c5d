"""The tracking figures in README, from runs over the bus: ``make figures`` writes, a test compares them."""

import argparse
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
BEGIN, END = "<!-- figures: begin -->\n", "<!-- figures: end -->\n"
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
                options = RunOptions(scenario, controller, Path(directory))
                recording = run_inprocess(options)
            trace = trace_of(recording, scenario, contract)
            result = result_of(recording, trace, contract, options, "inprocess")
            ours, paper = (f"{f['rms_mm']:.3f} / {f['max_mm']:.3f}" for f in (result, result["paper"]))
            lines.append(f"| {name} | {controller.upper()} | {ours} | {paper} |")
            if picture is not None and (name, controller) == ("sine", "adrc"):
                draw(picture, result, trace)
    return "\n".join(lines) + "\n"


def in_readme() -> str:
    """Return the table that README shows now."""
    return README.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]


def main() -> int:
    """Print the table, or write it and the picture into the project."""
    parser = argparse.ArgumentParser(description="Run all scenarios and print README's table of figures.")
    parser.add_argument("--write", action="store_true", help="rewrite README.md and docs/sine.png")
    if not parser.parse_args().write:
        print(table(), end="")
        return 0
    fresh = table(PICTURE)
    before, rest = README.read_text(encoding="utf-8").split(BEGIN)
    README.write_text(before + BEGIN + fresh + END + rest.split(END)[1], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
