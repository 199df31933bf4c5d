"""The pages show what was measured last."""

import pytest
from cost_figures import BLOCKS


@pytest.mark.parametrize(
    ("place", "content"), BLOCKS.items(), ids=[f"{page.name}-{block}" for block, page in BLOCKS]
)
def test_a_page_shows_what_was_measured_last(place, content):
    block, page = place
    shown = page.read_text(encoding="utf-8").split(f"<!-- {block}: begin -->\n")[1]
    assert shown.split(f"<!-- {block}: end -->\n")[0] == content(), "run make cost"
