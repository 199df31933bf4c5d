"""Reference images: what was built from the exported C, and whether it still is what would be built."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from elftools.elf.elffile import ELFFile

HERE = Path(__file__).parent
IMAGES = HERE / "images"
MANIFEST = IMAGES / "manifest.json"
EXPORTED = HERE.parent / "c"
TARGET = HERE.parent / "target"
RAM = 0x20000000, 0x4000
"""Begin and size, as in memory.ld."""


@dataclass(frozen=True, slots=True)
class Image:
    """A linked program.

    Attributes
    ----------
    segments : tuple of (int, bytes)
        Load address and contents.
    symbols : mapping of str to int
        Addresses; of functions without the bit that marks Thumb code.
    flash_bytes, ram_bytes : int
        Code, constants and initial values; variables, without the stack.
    """

    segments: tuple[tuple[int, bytes], ...]
    symbols: Mapping[str, int]
    flash_bytes: int
    ram_bytes: int


def source_digest() -> str:
    """Return the SHA-256 of all that the images are built from."""
    digest = hashlib.sha256()
    for path in sorted([*EXPORTED.glob("*.[ch]"), *TARGET.iterdir()]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def read_image(path: Path, symbols: Mapping[str, int]) -> Image:
    """Read an ELF file."""
    with path.open("rb") as file:
        loaded = [
            segment
            for segment in ELFFile(file).iter_segments("PT_LOAD")
            if segment["p_filesz"] or segment["p_memsz"]
        ]
        contents = tuple((segment["p_paddr"], segment.data()) for segment in loaded if segment["p_filesz"])
        in_ram = [segment["p_memsz"] for segment in loaded if segment["p_vaddr"] >= RAM[0]]
    return Image(contents, symbols, sum(len(data) for _, data in contents), sum(in_ram))


def reference_image(processor: str) -> Image:
    """Return the committed image of a processor."""
    entry = json.loads(MANIFEST.read_text())["images"][processor]
    return read_image(IMAGES / f"{processor}.elf", entry["symbols"])
