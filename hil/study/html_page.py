"""Pages of HTML that need nothing but themselves."""

from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, pictures: Mapping[str, Path], **context: Any) -> str:
    """Return a page.

    Parameters
    ----------
    template : str
        File in this folder; `style.html` is there to be included.
    pictures : mapping of Path
        SVG files by name, which the template has as `pictures`, to be used as they are.
    **context
        What else the template has.
    """
    environment = Environment(
        loader=PackageLoader("hil.study", "."), autoescape=True, undefined=StrictUndefined
    )
    uris = {name: _data_uri(path) for name, path in pictures.items()}
    return environment.get_template(template).render(context, pictures=uris)


def _data_uri(svg: Path) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.read_bytes()).decode()}"
