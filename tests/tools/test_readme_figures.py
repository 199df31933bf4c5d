"""README's figures are those of runs made now."""

from readme_figures import in_readme, table


def test_readme_shows_what_the_scenarios_give():
    assert in_readme() == table()
