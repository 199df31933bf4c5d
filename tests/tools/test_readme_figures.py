"""README's figures are those of runs made now, and of the last bench."""

from readme_figures import in_readme, speed_table, table


def test_readme_shows_what_the_scenarios_give():
    assert in_readme("figures") == table()


def test_readme_shows_what_the_last_bench_measured():
    assert in_readme("bench") == speed_table()
