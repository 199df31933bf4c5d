"""The evaluation as one page of HTML that needs nothing but itself."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.measure import METRICS
from hil.study import paper
from hil.study.figures import MAPPED_POINT
from hil.study.html_page import render


def page(tables: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """Return the page.

    Parameters
    ----------
    tables : mapping
        From `hil.study.evaluation.tables_of`.
    pictures : mapping of Path
        SVG files by name, from `hil.study.figures.save`.
    """
    return render(
        "report.html",
        pictures,
        **tables,
        metrics=METRICS,
        rows=len(METRICS) * len(tables["scenarios"]),
        paper_tables=[
            (paper.CASES[free].table, free, loaded)
            for free, loaded in paper.WITH_LOAD.items()
            if loaded in tables["scenarios"]
        ],
        mapped_point=MAPPED_POINT,
    )
