"""The exported C, compiled for this machine and fed through a pipe."""

import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from firmware_py import kernel_check

EXPORTED = Path(kernel_check.__file__).parent / "c"
"""The exported C as committed."""

STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wundef", "-Werror"]
BUILDS = {
    "optimised": ["-O2"],
    "sanitized": ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"],
}
"""Compiler options of each build; the sanitized one ends at the first undefined operation."""


def compiled(program: Path, sources: Iterable[Path], *options: str, include: Path = EXPORTED) -> Path:
    """Compile and link; any warning is an error."""
    command = ["gcc", *STRICT, *options, f"-I{include}", "-o", str(program), *map(str, sources)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return program


def output_of(program: Path, data: np.ndarray) -> bytes:
    """Feed a program through its standard input and return what it says."""
    result = subprocess.run([program], input=data.tobytes(), capture_output=True)
    assert result.returncode == 0, result.stderr.decode()[-2000:]
    assert not result.stderr, result.stderr.decode()[-2000:]
    return result.stdout
