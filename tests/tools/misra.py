"""Compare what cppcheck's MISRA addon reports of the exported C with the deviations listed: `make misra`."""

import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

from firmware_py import c_export

EXPORT = Path(c_export.__file__).parent
SOURCES = EXPORT.parent / "c"
COMMAND = ["cppcheck", "--addon=misra", "--std=c99", "--platform=unix32", "--enable=style", "--quiet"]


def main() -> int:
    """Print each difference; return 1 if there is one."""
    deviations = tomllib.loads((EXPORT / "misra.toml").read_text())["deviations"]
    command = [*COMMAND, f"-I{SOURCES}", *sorted(map(str, SOURCES.glob("*.c")))]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=True)
    except FileNotFoundError:
        print("cppcheck is not installed: apt-get install cppcheck", file=sys.stderr)
        return 1
    reports = re.findall(r"^(\S+:\d+):\d+: .*\[misra-c2012-([\d.]+)\]$", result.stderr, re.MULTILINE)
    if not reports:
        print(f"cppcheck's MISRA addon reports nothing at all, not even the deviations:\n{result.stderr}")
        return 1
    counts = Counter(rule for _, rule in reports)
    unlisted = [f"{place}: rule {rule} is no deviation" for place, rule in reports if rule not in deviations]
    obsolete = [f"misra.toml: rule {rule} is kept by now" for rule in deviations if rule not in counts]
    for line in (*unlisted, *obsolete):
        print(line)
    print(
        f"{len(counts)} rules deviated from, {counts.total()} times; all others that cppcheck checks are kept"
    )
    return 1 if unlisted or obsolete else 0


if __name__ == "__main__":
    sys.exit(main())
