"""The syntax-tree check accepts the firmware and catches each way to leave the subset."""

import pytest

from firmware_py.kernel_check import check, firmware_sources, main

HEADER = "from dbc.machine import Array32, div32, i32, i64, int32, int64\n"
HEADER += "from firmware_py.kernel.fixedpoint import absolute, sat32\n"
TABLES = "\nTABLE = (1, 2, 1 << 3)\nROWS = ((1, 2), (3, 4), (5, 6))\nMASK = (1 << 33) - 1\n"


def violations_of(snippet: str) -> list[str]:
    """Check `snippet`, a module of its own beside the kernel's, whose first line is line 3."""
    found = check(firmware_sources() | {"snippet": ("snippet.py", HEADER + snippet)})
    assert all(line.startswith("snippet.py:") for line in found)
    return [line.removeprefix("snippet.py:") for line in found]


def in_function(statement: str) -> str:
    parameters = "a: int32, b: int32, wide: int64, state: Array32"
    return f"{TABLES}def f({parameters}) -> int64:\n    {statement}\n    return wide\n"


def test_the_firmware_stays_in_its_subset(capsys):
    assert check(firmware_sources()) == []
    assert main() == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "statement",
    [
        "x = i64(a) * i64(b)",
        "state[0] = sat32(wide + i64(a))",
        "state[0] = i32(a + b)",
        "state[a + 1] = state[b]",
        "x = div32(a, 3)",
        "for n in range(4):\n        state[n] = 0",
        "while a > 0:\n        a = a - 1",
        "state[0] = (a + b) & 0xFF",
        "state[0] = a >> 1 ^ b | TABLE[a]",
        "for n in range(len(ROWS)):\n        state[n] = ROWS[n][1]",
        "wide = (wide & MASK) >> 1",
    ],
)
def test_what_the_subset_allows(statement):
    assert violations_of(in_function(statement)) == []


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("x = a * b", "product without 64-bit operands: a * b"),
        ("x = i64(a) * b", "product without 64-bit operands: i64(a) * b"),
        ("x = 2 * a", "product without 64-bit operands: 2 * a"),
        ("x = i64(a * b)", "product without 64-bit operands: a * b"),
        ("state[0] = wide", "unnarrowed store: wide"),
        ("state[0] = a + b", "unnarrowed store: a + b"),
        ("state[0] = i64(a)", "unnarrowed store: i64(a)"),
        ("state[0] = -a", "unnarrowed store: -a"),
        ("state[0] = 2147483648", "unnarrowed store: 2147483648"),
        ("a = wide", "width of a changes from 32 to 64"),
        ("x = sat32(a)", "sat32 takes 64, not 32: a"),
        ("x = absolute(state)", "absolute takes 64, not array: state"),
        ("x = state[wide]", "a 64-bit index"),
        ("x = 1.5", "float literal 1.5"),
        ("x = a / b", "division by an operator, use div32: a / b"),
        ("x = a // b", "division by an operator, use div32: a // b"),
        ("x = a % b", "division by an operator, use div32: a % b"),
        ("x = a ** 2", "not in the subset: Pow"),
        ("x = [a, b]", "allocation: List"),
        ("x = {}", "allocation: Dict"),
        ("x = (a, b)", "allocation: Tuple"),
        ("x = TABLE[wide]", "a 64-bit index"),
        ("TABLE[0] = 1", "not an array: TABLE"),
        ("x = ROWS[0]", "not an integer: ROWS[0]"),
        ("x = a[0]", "not an array: a"),
        ("x = len(state)", "call of len, which is no function of the subset"),
        ("state[0] = (a + b) << 1", "unnarrowed store: a + b << 1"),
        ("state[0] = wide & 1", "unnarrowed store: wide & 1"),
        ("x = [n for n in range(3)]", "allocation: ListComp"),
        ("x = lambda: a", "allocation: Lambda"),
        ("x = f'{a}'", "allocation: JoinedStr"),
        ("x = list(a)", "call of list, which is no function of the subset"),
        ("x = state.copy()", "not in the subset: Call"),
        ("x = state[0:2]", "not in the subset: Slice"),
        ("x = unknown", "unknown is unknown here"),
        ("x = True", "not in the subset: Constant"),
        ("x = 'text'", "not in the subset: Constant"),
        ("x = a if a > b else b", "not in the subset: IfExp"),
        ("x = a > b", "not an integer: a > b"),
        ("a += 1", "not in the subset: AugAssign"),
        ("x = y = a", "not in the subset: Assign"),
        ("if a:\n        x = b", "a condition is a comparison"),
        ("if a < b < 3:\n        x = b", "not in the subset: Compare"),
        ("for n in range(a):\n        x = n", "the bounds of a for are constants"),
        (
            "for n in state:\n        x = n",
            "not in the subset: a for that does not run over a constant range",
        ),
        ("while a > 0:\n        a = a - 1\n    else:\n        b = a", "not in the subset: else of a loop"),
        ("try:\n        x = a\n    finally:\n        x = b", "not in the subset: Try"),
        ("import math", "not in the subset: Import"),
    ],
)
def test_what_the_check_catches(statement, message):
    found = violations_of(in_function(statement))
    assert len(found) == 1, found
    assert message in found[0]


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("import math\n", "3: import from outside the subset: math"),
        ("from firmware_py.tuning import P\n", "3: import from outside the subset: firmware_py.tuning"),
        ("x = 0.5\n", "3: a module holds only imports, integer constants, tables and functions"),
        (
            "class Thing:\n    pass\n",
            "3: a module holds only imports, integer constants, tables and functions",
        ),
        ("def f(a: float) -> int32:\n    return 0\n", "3: f: annotate with int32, int64, Array32, None"),
        ("def f(a) -> int32:\n    return 0\n", "3: f: annotate with int32, int64, Array32, None"),
        ("def f(a: int32 = 0) -> int32:\n    return a\n", "only plain positional parameters"),
        ("def f(a: int64) -> int32:\n    return a\n", "4: unnarrowed result: a"),
        ("def f(a: int32) -> int32:\n    return a + 1\n", "4: unnarrowed result: a + 1"),
        ("def f(a: int32) -> int64:\n    return a\n", "4: result is not int64"),
        ("def f(a: int64) -> int64:\n    return\n", "4: a return without its value"),
    ],
)
def test_module_level_rules(module, message):
    found = violations_of(module)
    assert len(found) == 1, found
    assert message in found[0]


def test_every_violation_of_a_function_is_reported_with_its_line():
    found = violations_of(in_function("x = a * b\n    state[0] = wide"))
    assert [line.split(":")[0] for line in found] == ["8", "9"]
