"""The mutation run: what it changes, what it notices, when it complains. The whole is `make mutation`."""

import subprocess
import sys
from pathlib import Path

import mutation
import pytest
from mutators import Mutant, mutants

SOURCE = '''
LIMIT = 3

class Gate:
    """Text stays."""

    size: int = 1

    def is_open(self, x: "int | 2", y=True):
        """Text stays."""
        x += 4
        if not x < LIMIT and y:
            return swap(x, y)
        return min(x, y) if x in y else -x
'''


def changes(scope: str) -> list[str]:
    return [mutant.change for mutant in mutants("gate.py", SOURCE) if mutant.scope == scope]


def test_what_is_changed_at_import():
    assert changes("") == ["3 -> 4", "3 -> 2", "1 -> 2", "1 -> 0", "True -> False"]


def test_what_is_changed_in_a_function():
    assert changes("Gate.is_open") == [
        "x += 4 -> x -= 4",
        "x += 4 -> pass",
        "4 -> 5",
        "4 -> 3",
        "if not x < LIMIT and y -> if not (not x < LIMIT and y)",
        "not x < LIMIT and y -> not x < LIMIT or y",
        "not x < LIMIT -> x < LIMIT",
        "x < LIMIT -> x <= LIMIT",
        "x < LIMIT -> x >= LIMIT",
        "return swap(x, y) -> return 0",
        "swap(x, y) -> swap(y, x)",
        "return min(x, y) if x in y else -x -> return 0",
        "x in y -> x not in y",
        "-x -> x",
    ]


def test_each_mutant_is_one_change_that_compiles():
    found = mutants("gate.py", SOURCE)
    original = compile(SOURCE, "gate.py", "exec")
    assert all(mutant.compile("gate.py") != original for mutant in found)
    assert len({mutant.key for mutant in found}) == len(found)


def test_the_same_change_twice_in_a_line_is_told_apart():
    assert [m.change for m in mutants("a.py", "x = [7, 7]")] == ["7 -> 8", "7 -> 6", "7 -> 8 #2", "7 -> 6 #2"]


def some_mutants(count: int) -> list[Mutant]:
    return mutants("a.py", "".join(f"x{n} = {10 + n}\n" for n in range(count // 2)))


@pytest.mark.parametrize(
    ("survivors", "argued", "complaint"),
    [
        (slice(0, 0), slice(0, 0), None),
        (slice(0, 2), slice(0, 2), None),
        (slice(0, 2), slice(0, 1), "survives without an argument: a.py:1 in module: 10 -> 9"),
        (slice(0, 1), slice(0, 2), "argues what does not survive: a.py in module: 10 -> 9"),
        (slice(0, 3), slice(0, 3), "score 92.5 % is below 95.0 %"),
    ],
)
def test_when_it_complains(survivors, argued, complaint):
    found = some_mutants(40)
    reasons = {mutant.key: "because" for mutant in found[argued]}
    said = list(mutation.complaints(found, found[survivors], reasons, complete=True))
    assert len(said) == (complaint is not None)
    assert all(complaint in line for line in said)


def test_an_argument_without_a_reason_is_none():
    found = some_mutants(40)
    said = list(mutation.complaints(found, found[:1], {found[0].key: " "}, complete=True))
    assert said == ["survives without an argument: a.py:1 in module: 10 -> 11"]


@pytest.mark.parametrize(
    ("line", "row"),
    [
        ("remaining = max(abs(drive[SPEED_COUNTS])", "| all | 4 | 4 | 100.0 % |"),  # within a function
        ("MISSED_COMMANDS_LIMIT = 3", "| all | 2 | 2 | 100.0 % |"),  # at import
        ("if _NEXT_AFTER_RAMP[drive[STATE]] >= 0:", "| all | 4 | 2 | 50.0 % |"),  # no state is 0
    ],
)
def test_faults_of_the_drive_are_noticed_and_what_changes_nothing_is_not(line, row):
    script = Path(mutation.__file__)
    command = [sys.executable, str(script), "--only", "drive", "--line", line]
    result = subprocess.run(command, capture_output=True, text=True)
    assert row in result.stdout
    assert result.returncode == 0, result.stderr
