"""What the firmware costs on its processors, in README and docs/silicon.md: from ``make cost``."""

import json
import sys
from typing import Any

from readme_figures import README, ROOT, write_to_page

from firmware_py.chosen_firmware import COST
from hil.study.cost_command import HEADINGS, rows

PAGE = ROOT / "docs" / "silicon.md"
README_PROCESSORS = ("cortex-m0plus", "cortex-m4", "rv32imc")
README_ROWS = ("P", "PI", "ADRC", "robust ADRC")


def figures() -> dict[str, Any]:
    """Return what was measured last."""
    measured: dict[str, Any] = json.loads(COST.read_text(encoding="utf-8"))
    return measured


def _markdown(headings: tuple[str, ...], lines: list[tuple[str, ...]]) -> str:
    ruler = tuple("---" if number < 2 else "---:" for number in range(len(headings)))
    return "".join(f"| {' | '.join(line)} |\n" for line in (headings, ruler, *lines))


def whole_table() -> str:
    """Return the bill as a Markdown table."""
    return _markdown(HEADINGS, rows(figures()))


def readme_table() -> str:
    """Return the bill of `README_PROCESSORS` in short."""
    shown = [row for row in rows(figures()) if row[0].startswith(README_PROCESSORS) and row[1] in README_ROWS]
    columns = (0, 1, 2, 6, 7, 9, 10)
    return _markdown(tuple(HEADINGS[n] for n in columns), [tuple(row[n] for n in columns) for row in shown])


def memory_table() -> str:
    """Return code, RAM and stack of each image as a Markdown table."""
    headings = ("processor", "compiler", "flash, bytes", "RAM, bytes", "stack, bytes")
    measured = figures()
    return _markdown(
        headings,
        [
            (
                name,
                measured["compiler"],
                *(str(one[key]) for key in ("flash_bytes", "ram_bytes", "stack_bytes")),
            )
            for name, one in measured["processors"].items()
        ],
    )


def compilers_table() -> str:
    """Return ADRC as each compiler makes it, as a Markdown table."""
    headings = (
        "processor",
        "compiler",
        "mean of the sine",
        "worst of the sine",
        "worst of jumps",
        "cycles, worst of jumps",
        "flash, bytes",
    )
    lines = [
        (
            processor,
            compiler,
            f"{one['sine']['mean_instructions']:.0f}",
            str(one["sine"]["worst_instructions"]),
            str(one["jumps"]["worst_instructions"]),
            "{}-{}".format(*one["jumps"]["worst_cycles"]),
            str(one["flash_bytes"]),
        )
        for compiler, built in figures()["compilers"].items()
        for processor, one in built.items()
    ]
    return _markdown(headings, sorted(lines))


BLOCKS = {
    ("cost", README): readme_table,
    ("cost", PAGE): whole_table,
    ("memory", PAGE): memory_table,
    ("compilers", PAGE): compilers_table,
}
"""Name of each block and its page, and what makes it."""


def main() -> int:
    """Rewrite all blocks."""
    for (block, page), content in BLOCKS.items():
        write_to_page(block, content(), page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
