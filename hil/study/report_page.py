"""The evaluation as one page of HTML that needs nothing but itself."""

from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from hil.study import paper
from hil.study.evaluation import METRICS
from hil.study.figures import MAPPED_POINT


def page(tables: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """Return the page.

    Parameters
    ----------
    tables : mapping
        From `hil.study.evaluation.tables_of`.
    pictures : mapping of Path
        SVG files by name, from `hil.study.figures.save`.
    """
    environment = Environment(
        loader=PackageLoader("hil.study", "."), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template("report.html").render(
        tables,
        metrics=METRICS,
        rows=len(METRICS) * len(tables["scenarios"]),
        paper_tables=[
            (paper.CASES[free].table, free, loaded)
            for free, loaded in paper.WITH_LOAD.items()
            if loaded in tables["scenarios"]
        ],
        mapped_point=MAPPED_POINT,
        pictures={name: _data_uri(path) for name, path in pictures.items()},
    )


def _data_uri(svg: Path) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.read_bytes()).decode()}"
