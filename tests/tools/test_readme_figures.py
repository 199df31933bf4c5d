"""README's figures are those of the last evaluation, which tests/hil repeats, and of the last bench."""

from readme_figures import in_readme, speed_table, table


def test_readme_shows_the_last_evaluation():
    assert in_readme("figures") == table()


def test_readme_shows_what_the_last_bench_measured():
    assert in_readme("bench") == speed_table()
