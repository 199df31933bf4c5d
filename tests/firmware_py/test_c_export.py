"""The exporter says in C what the source says, and refuses what it does not understand."""

import re

import pytest

from firmware_py.c_export.__main__ import main
from firmware_py.c_export.expressions import ExportError
from firmware_py.c_export.program import Program
from firmware_py.kernel_check import MACHINE, firmware_sources

HEADER = "from dbc.machine import Array32, div32, i32, i64, int32, int64\n"


def program_of(source: str) -> Program:
    """A program of one module, with f for others to call."""
    machine = {MACHINE: firmware_sources()[MACHINE]}
    return Program({**machine, "snippet": ("snippet.py", HEADER + source)}, public=("f",), internal=())


def c_of(source: str) -> str:
    program = program_of(source)
    return "\n".join(
        [*program.constants("snippet"), *program.tables("snippet"), *program.functions("snippet")]
    )


def statements_of(body: str, parameters: str = "a: int32, wide: int64, state: Array32") -> str:
    """C of a function's body, in one line."""
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    return " ".join(c_of(f"def f({parameters}) -> None:\n{lines}").partition("{")[2].split())


@pytest.mark.parametrize(
    ("python", "c"),
    [
        ("x = (i64(a) - wide) * i64(a)", "int64_t x = ((int64_t)a - wide) * (int64_t)a;"),
        ("x = wide - (wide - i64(a))", "int64_t x = wide - (wide - (int64_t)a);"),
        ("x = wide - wide + i64(a)", "int64_t x = wide - wide + (int64_t)a;"),
        ("x = i64(a) << 3", "int64_t x = shl64((int64_t)a, 3);"),
        ("x = a << 3 >> 1", "int32_t x = shl32(a, 3) >> 1;"),
        ("x = -(-a)", "int32_t x = -(-a);"),
        ("x = div32(a + 1, 3)", "int32_t x = (int32_t)((uint32_t)(a + 1) / (uint32_t)3);"),
        ("x = (a & 0x0F) ^ -0x10", "int32_t x = (a & 0x0F) ^ (-0x10);"),
        ("x = -2147483648", "int64_t x = -INT64_C(2147483648);"),
        ("x = 4294967296", "int64_t x = INT64_C(4294967296);"),
        ("state[a + 1] = i32(a + 1)", "state[a + 1] = (int32_t)(a + 1);"),
        (
            "if a > 0 and not a == 3 or wide < 1:\n    a = 1",
            "if (((a > 0) && !(a == 3)) || (wide < 1)) { a = 1; }",
        ),
        (
            "if a > 0:\n    a = 1\nelif a == 2:\n    a = 2\nelse:\n    a = 3",
            "if (a > 0) { a = 1; } else if (a == 2) { a = 2; } else { a = 3; }",
        ),
        ("for n in range(2, 4):\n    state[n] = 0", "for (int32_t n = 2; n < 4; n++) { state[n] = 0; }"),
        ("while a > 0:\n    a = a - 1", "while (a > 0) { a = a - 1; }"),
        ("if a > 0:\n    x = 1\n    a = x\nx = 2", None),
    ],
)
def test_statements(python, c):
    if c is None:
        with pytest.raises(ExportError, match=r"snippet.py:4: x may be unset where it is used"):
            statements_of(python)
    else:
        assert c in statements_of(python)


def test_constants_tables_and_their_comments():
    text = c_of(
        "# what it is\nFIRST = 1 << 4  # said beside\nWIDE = 1 << 40\n"
        "ROWS = ((FIRST, 2), (-1, FIRST | 1))\nBYTES = (0x01, 255)\n"
        "def f(a: int32) -> int32:\n    return ROWS[a][1] | BYTES[len(ROWS) - 1]\n"
    )
    assert "/* what it is */\nenum {\n    DDH_FIRST = 16, /* said beside */\n};" in text
    assert "#define DDH_WIDE INT64_C(1099511627776)" in text
    assert (
        "static const int32_t DDH_ROWS[2][2] = {\n    {DDH_FIRST, 2},\n    {-1, DDH_FIRST | 1},\n};" in text
    )
    assert "static const uint8_t DDH_BYTES[2] = {\n    0x01, 255\n};" in text
    assert "return DDH_ROWS[a][1] | (int32_t)DDH_BYTES[2 - 1];" in text


def test_arrays_that_are_not_stored_into_are_const():
    text = c_of(
        "def g(a: Array32, b: Array32) -> None:\n    a[0] = b[0]\n"
        "def f(a: Array32, b: Array32, c: Array32) -> None:\n    g(b, a)\n"
    )
    assert "static void g(int32_t *a, const int32_t *b)" in text
    assert "void ddh_f(const int32_t *a, int32_t *b, const int32_t *c)\n{\n    (void)c;\n    g(b, a);" in text


def test_a_function_comes_behind_those_it_calls_and_none_that_is_not_called():
    text = c_of("def f() -> None:\n    g()\ndef g() -> None:\n    return\ndef h() -> None:\n    return\n")
    assert text.index("static void g(") < text.index("void ddh_f(")
    assert "h(" not in text


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def f(a: float) -> None:\n    return\n", "snippet.py:2: f: annotate with int32"),
        ("def f(a: int32) -> None:\n    x = a * a\n", "snippet.py:3: product without 64-bit operands: a * a"),
        ("def f(a: int32) -> None:\n    register = a\n", "snippet.py:3: register means something else in C"),
        (
            "def g() -> None:\n    return\ndef h(g: int32) -> None:\n    return\n"
            "def f() -> None:\n    g()\n    h(1)\n",
            "snippet.py:4: g means something else in C",
        ),
        ("def g() -> None:\n    f()\ndef f() -> None:\n    g()\n", "recursion: g -> f -> g"),
        (
            "def f(a: Array32) -> None:\n    for n in range(0, 4, 2):\n        a[n] = 0\n",
            "a range has no step",
        ),
    ],
)
def test_what_it_refuses(source, message):
    with pytest.raises(ExportError, match=re.escape(message)):
        c_of(source)


def test_c_has_one_name_space():
    sources = {MACHINE: firmware_sources()[MACHINE]}
    sources |= {name: (f"{name}.py", f"{HEADER}SIZE = 1\n") for name in ("one", "two")}
    with pytest.raises(ExportError, match=r"two.py:1: SIZE is defined in one too"):
        Program(sources, public=(), internal=())


def test_the_command_writes_the_files(tmp_path):
    assert main([str(tmp_path / "new" / "place"), "--tuning", "paper"]) == 0
    files = {path.name for path in (tmp_path / "new" / "place").iterdir()}
    assert files == {"ddh_controller.h", "ddh_controller.c", "ddh_calibration.c"}
    assert "Calibration: paper." in (tmp_path / "new" / "place" / "ddh_calibration.c").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tuning", "none"], "there is no tuning 'none'"),
        (["--dbc", "none.dbc"], "none.dbc: cannot be read"),
    ],
)
def test_bad_input_is_refused_in_one_line(tmp_path, capsys, arguments, message):
    assert main([str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_directory_that_cannot_be_written_is_refused(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main([str(tmp_path / "file")]) == 2
    assert "cannot write to" in capsys.readouterr().err
