"""Pages show the last evaluation, which tests/hil repeats, and the last bench."""

import re

from readme_figures import ROOT, STUDIES, in_page, speed_table, stability_table, state_space_table, table


def test_readme_shows_the_last_evaluation():
    assert in_page("figures") == table()


def test_the_studies_show_the_last_evaluation():
    assert in_page("stability", STUDIES) == stability_table()
    assert in_page("state space", STUDIES) == state_space_table()


def test_readme_shows_what_the_last_bench_measured():
    assert in_page("bench") == speed_table()


def test_the_tests_that_the_paper_page_names_exist():
    named = re.findall(r"`(tests/\S+\.py)`", (ROOT / "docs" / "paper.md").read_text(encoding="utf-8"))
    assert len(named) > 3
    assert all((ROOT / name).is_file() for name in named)
