"""Play the faults and write their tables into ``docs/fault_matrix.md`` (``make faults``)."""

import json
import sys

from readme_figures import ROOT, write_to_page

from hil import cli
from hil.study import stuck_sensor
from hil.study.fault_pages import markdown
from hil.study.faults_command import EXIT_OK, EXIT_UNEXPECTED

PAGE = ROOT / "docs" / "fault_matrix.md"


def main() -> int:
    """Return the exit code of ``hil faults``."""
    out = ROOT / "out" / "faults"
    code = cli.main(["faults", "--out", str(out)])
    if code not in (EXIT_OK, EXIT_UNEXPECTED):
        return code
    matrix = json.loads((out / "matrix.json").read_text(encoding="utf-8"))
    write_to_page("matrix", markdown(matrix), PAGE)
    write_to_page("stuck", stuck_sensor.markdown(), PAGE)
    return code


if __name__ == "__main__":
    sys.exit(main())
