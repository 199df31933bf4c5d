"""README's figures are those of the last evaluation, which tests/hil repeats, and of the last bench."""

import re

from readme_figures import ROOT, in_readme, speed_table, table


def test_readme_shows_the_last_evaluation():
    assert in_readme("figures") == table()


def test_readme_shows_what_the_last_bench_measured():
    assert in_readme("bench") == speed_table()


def test_the_tests_that_the_paper_page_names_exist():
    named = re.findall(r"`(tests/\S+\.py)`", (ROOT / "docs" / "paper.md").read_text(encoding="utf-8"))
    assert len(named) > 3
    assert all((ROOT / name).is_file() for name in named)
