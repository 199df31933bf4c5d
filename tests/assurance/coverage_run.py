"""Line and branch coverage of the modules in assurance.toml: `make coverage`. Fails below 100 %."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from groups import ENVIRONMENT, ROOT, read_groups


def main() -> int:
    """Run the tests interpreted, print the report; 0 if every line and branch was taken."""
    groups = read_groups()
    targets = ",".join(target for group in groups for target in group.targets)
    tests = dict.fromkeys(argument for group in groups for argument in (*group.options, *group.tests))
    with tempfile.TemporaryDirectory() as directory:
        data = Path(directory) / "coverage"
        environment = os.environ | ENVIRONMENT | {"COVERAGE_FILE": str(data)}
        coverage = [sys.executable, "-m", "coverage"]
        steps = (
            [*coverage, "run", "--branch", f"--include={targets}", "-m", "pytest", *tests],
            [*coverage, "report", "--show-missing", "--skip-empty", "--fail-under=100"],
        )
        return max(subprocess.run(step, cwd=ROOT, env=environment).returncode for step in steps)


if __name__ == "__main__":
    sys.exit(main())
