"""Lines of keys in TOML texts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.toml_lines import line_of

TEXT = '''\
# a comment
title = """
text = 1
"""   # ends here

load = [
  [1.0, 2.0],
]
[limits.adrc]
rms_mm = 1
dotted.key = 2
inline = { a = 1 }

[[fault]]
kind = "a"
[[fault]]

kind = "b"
'''


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("title",), 2),
        (("text",), None),
        (("load",), 6),
        (("load", 0), 6),
        (("limits",), 9),
        (("limits", "adrc"), 9),
        (("limits", "adrc", "rms_mm"), 10),
        (("limits", "adrc", "dotted", "key"), 11),
        (("limits", "adrc", "inline", "a"), 12),
        (("fault",), 14),
        (("fault", 0, "kind"), 15),
        (("fault", 1), 16),
        (("fault", 1, "kind"), 18),
        (("fault", 2), None),
        (("title", "deeper"), None),
        ((), 1),
    ],
)
def test_the_line_of_a_key(path, line):
    assert line_of(TEXT, path) == line


@given(st.lists(st.sampled_from(["", "# note", "{key} = 1", "{key} = [\n1,\n2]", '{key} = """\n[a]\n"""'])))
def test_whatever_is_above_a_key(blocks):
    texts = [block.replace("{key}", f"key{number}") for number, block in enumerate(blocks)]
    above = sum(text.count("\n") + 1 for text in texts)
    assert line_of("\n".join([*texts, "wanted = 3", "below = 4"]), ("wanted",)) == above + 1
