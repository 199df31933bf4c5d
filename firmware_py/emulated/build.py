"""``python -m firmware_py.emulated.build``: rebuild the reference images from the exported C."""

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

from firmware_py.emulated.image import EXPORTED, IMAGES, MANIFEST, TARGET, Image, read_image, source_digest
from firmware_py.emulated.processors import COMPILERS, TARGETS

SYMBOLS = (
    "bss_end",
    "can_receive_handler",
    "controller",
    "ddh_calibration",
    "ddh_control_reset",
    "ddh_control_step",
    "idle",
    "reset_handler",
    "run_segment",
    "stack_top",
    "timer_handler",
)
FLAGS = ("-std=c99", "-O2", "-g0", "-ffunction-sections", "-fdata-sections")
CALLED = ("timer_handler", "can_receive_handler", "run_segment")
LINK_FLAGS = (
    "-Wl,--gc-sections",
    "-Wl,--entry=reset_handler",
    *(f"-Wl,-u,{function}" for function in CALLED),
    "-Wl,-n",
)


class BuildError(Exception):
    """The compiler is missing or refused; the message says what to do."""


def compiler_version(compiler: str, processor: str) -> str:
    """Return the name and version of a compiler for a processor.

    Raises
    ------
    BuildError
        If it is not installed.
    """
    command = _command(compiler, processor)
    if compiler == "zig":
        return f"zig cc {_output([*command[:-1], 'version']).strip()}"
    return _output([*command, "--version"]).splitlines()[0]


def flags_of(compiler: str, processor: str, optimisation: str = "-O2") -> list[str]:
    """Return what a compiler is told to build for a processor."""
    target = TARGETS[processor]
    flags = [optimisation if flag == "-O2" else flag for flag in (*FLAGS, *LINK_FLAGS)]
    if compiler == "zig":
        return [*target.instructions.zig, target.zig, *flags]
    return [*target.instructions.gcc[1:], target.gcc, "-ffreestanding", "-nostdlib", *flags]


def build(compiler: str, processor: str, optimisation: str = "-O2", keep: Path | None = None) -> Image:
    """Compile and link the firmware.

    Parameters
    ----------
    compiler : str
        One of `COMPILERS`.
    processor : str
        One of `TARGETS`.
    optimisation : str
        Compiler option.
    keep : Path, optional
        Where to leave the ELF file, without its symbols.
    """
    target = TARGETS[processor]
    names = ["startup.c", "segment.c", *target.instructions.sources, *target.sources]
    if compiler == "gcc":
        names.append("libc.c")
    sources = [*sorted(EXPORTED.glob("*.c")), *(TARGET / name for name in names)]
    command = [*_command(compiler, processor), *flags_of(compiler, processor, optimisation)]
    command += [f"-I{EXPORTED}", f"-I{TARGET}", f"-Wl,-T,{TARGET / 'memory.ld'}", *map(str, sources)]
    last = ["-lgcc"] if compiler == "gcc" else []
    with tempfile.TemporaryDirectory() as directory:
        whole, stripped = Path(directory) / "whole.elf", Path(directory) / "stripped.elf"
        _output([*command, "-o", str(whole), *last])
        _output([*command, "-s", "-o", str(stripped), *last])
        image = read_image(whole, _symbols(whole, target.instructions.code_bit))
        if read_image(stripped, image.symbols) != image:
            raise BuildError(f"{compiler}: stripping changed the program")
        if keep is not None:
            shutil.copyfile(stripped, keep)
    return image


def _symbols(path: Path, code_bit: int) -> dict[str, int]:
    with path.open("rb") as file:
        table = ELFFile(file).get_section_by_name(".symtab")
        assert isinstance(table, SymbolTableSection)
        found = {symbol.name: symbol for symbol in table.iter_symbols()}
        return {name: found[name]["st_value"] & ~code_bit for name in SYMBOLS}


def _command(compiler: str, processor: str) -> list[str]:
    if compiler == "zig":
        return [sys.executable, "-m", "ziglang", "cc"]
    return [TARGETS[processor].instructions.gcc[0]]


def _output(command: list[str]) -> str:
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=True)
    except FileNotFoundError as error:
        raise BuildError(f"{command[0]} is not installed") from error
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or ["no message"]
        if "No module named ziglang" in error.stderr:
            lines = ["ziglang is not installed: pip install -e '.[arm]'"]
        raise BuildError(f"{command[0]}: {lines[0]}") from error
    return result.stdout


def main(argv: list[str] | None = None) -> int:
    """Build all images and write the manifest."""
    parser = argparse.ArgumentParser(prog="python -m firmware_py.emulated.build", description=__doc__)
    parser.parse_args(argv)
    IMAGES.mkdir(exist_ok=True)
    compiler = COMPILERS[0]
    try:
        images = {}
        for processor in TARGETS:
            path = IMAGES / f"{processor}.elf"
            image = build(compiler, processor, keep=path)
            images[processor] = {
                "flags": flags_of(compiler, processor),
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "symbols": dict(image.symbols),
            }
        version = compiler_version(compiler, next(iter(TARGETS)))
    except BuildError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    manifest = {"compiler": version, "sources_sha256": source_digest(), "images": images}
    MANIFEST.write_text(json.dumps(manifest, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
