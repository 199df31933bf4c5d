"""A processor in Unicorn: memory, calls, and what they cost.

It has no interrupt controller and no timer: whoever uses it calls the handlers. The Unicorn engine is
licensed under the GPL, version 2: it is an optional extra, and nothing of it is part of this package.
"""

from collections.abc import Iterable
from importlib import import_module
from struct import pack, unpack

import unicorn
from unicorn import UC_HOOK_BLOCK, UC_PROT_ALL, Uc, UcError

from firmware_py.emulated.cycles import Cost, cost_of
from firmware_py.emulated.image import RAM, Image
from firmware_py.emulated.processors import TARGETS, Target

FLASH = 0x08000000, 0x20000
SCRATCH = 0x60000000, 0x400000
"""Memory that no real part has: for what tests exchange with the program."""
PERIPHERALS = 0x40006000, 0x1000
_RETURN = 0x0FFF_F000
"""Where calls return to; nothing else lies in its page."""
_PAINT = 0xC5


class EmulationError(Exception):
    """The program did what the processor refuses, or the emulator is not the processor asked for."""


class Machine:
    """A processor with a program in its memory.

    Parameters
    ----------
    processor : str
        One of `TARGETS`.
    image : Image
        The program.

    Attributes
    ----------
    cost : Cost
        Of the last call, if costs are counted.

    Raises
    ------
    EmulationError
        If the emulator takes an instruction that the processor has not, or refuses one that it has.
    """

    def __init__(self, processor: str, image: Image) -> None:
        self.image = image
        self.cost = Cost(0, 0, 0)
        self._processor = processor
        target = TARGETS[processor]
        _self_test(processor, target)
        self._uc = _new_processor(target)
        instructions = target.instructions
        self._code_bit = instructions.code_bit
        self._arguments = [_register(target, name) for name in instructions.arguments]
        self._stack_pointer = _register(target, instructions.stack_pointer)
        self._return_address = _register(target, instructions.return_address)
        self._program_counter = _register(target, "PC")
        for begin, size in (FLASH, RAM, SCRATCH, PERIPHERALS, (_RETURN, 0x1000)):
            self._uc.mem_map(begin, size, UC_PROT_ALL)
        for address, contents in image.segments:
            self._uc.mem_write(address, contents)
        self._blocks: dict[tuple[int, int], Cost] = {}
        self._counted: list[Cost] = []

    def count_costs(self) -> None:
        """Count instructions and cycles of each call from now on."""
        self._uc.ctl_flush_tb()  # type: ignore[attr-defined]
        self._uc.hook_add(UC_HOOK_BLOCK, self._enter_block)

    def start(self) -> None:
        """Power-on: run from the reset handler until the program idles."""
        self._uc.reg_write(self._stack_pointer, self.image.symbols["stack_top"])
        self._run(self.image.symbols["reset_handler"], self.image.symbols["idle"])

    def call(self, function: str, *arguments: int) -> int:
        """Call a function by its symbol, as an interrupt would; return its result."""
        for register, value in zip(self._arguments, arguments, strict=False):
            self._uc.reg_write(register, value)
        self._uc.reg_write(self._stack_pointer, self.image.symbols["stack_top"])
        self._uc.reg_write(self._return_address, _RETURN | self._code_bit)
        self._run(self.image.symbols[function], _RETURN)
        return int(self._uc.reg_read(self._arguments[0]))

    def write(self, address: int, contents: bytes) -> None:
        """Write memory."""
        self._uc.mem_write(address, contents)

    def write_words(self, address: int, words: Iterable[int]) -> None:
        """Write 32-bit words."""
        self._uc.mem_write(address, b"".join(pack("<I", word & 0xFFFF_FFFF) for word in words))

    def read(self, address: int, size: int) -> bytes:
        """Read memory."""
        return bytes(self._uc.mem_read(address, size))

    def read_words(self, address: int, count: int) -> tuple[int, ...]:
        """Read signed 32-bit words."""
        return unpack(f"<{count}i", self._uc.mem_read(address, 4 * count))

    def paint_stack(self) -> None:
        """Fill the RAM above the variables with a pattern."""
        begin, end = self._stack()
        self._uc.mem_write(begin, bytes([_PAINT]) * (end - begin))

    def stack_bytes(self) -> int:
        """Return how much of the stack has been used since it was painted."""
        begin, end = self._stack()
        untouched = self.read(begin, end - begin)
        return len(untouched.lstrip(bytes([_PAINT])))

    def _stack(self) -> tuple[int, int]:
        return self.image.symbols["bss_end"], self.image.symbols["stack_top"]

    def _run(self, begin: int, end: int) -> None:
        self._counted.clear()
        try:
            self._uc.emu_start(begin | self._code_bit, end)
        except UcError as error:
            at = self._uc.reg_read(self._program_counter)
            raise EmulationError(f"{self._processor}: {error} at {at:#010x}") from error
        self.cost = Cost(*map(sum, zip(*self._counted, strict=True))) if self._counted else Cost(0, 0, 0)

    def _enter_block(self, uc: Uc, address: int, size: int, _: object) -> None:
        cost = self._blocks.get((address, size))
        if cost is None:
            cost = self._blocks[address, size] = cost_of(bytes(uc.mem_read(address, size)), self._processor)
        self._counted.append(cost)


def _new_processor(target: Target) -> Uc:
    instructions = target.instructions
    uc = Uc(
        getattr(unicorn, f"UC_ARCH_{instructions.architecture}"),
        getattr(unicorn, f"UC_MODE_{instructions.mode}"),
    )
    uc.ctl_set_cpu_model(_constant(target, f"CPU_{target.model}"))
    return uc


def _register(target: Target, name: str) -> int:
    return _constant(target, f"{target.instructions.architecture}_REG_{name}")


def _constant(target: Target, name: str) -> int:
    constants = import_module(f"unicorn.{target.instructions.architecture.lower()}_const")
    return int(getattr(constants, f"UC_{name}"))


def _self_test(processor: str, target: Target) -> None:
    """Make sure that the emulator is the processor asked for."""
    for code in (*target.has, *target.lacks):
        uc = _new_processor(target)
        uc.mem_map(FLASH[0], 0x1000, UC_PROT_ALL)
        uc.mem_write(FLASH[0], code)
        try:
            uc.emu_start(FLASH[0] | target.instructions.code_bit, FLASH[0] + len(code))
            refused = False
        except UcError:
            refused = True
        if refused != (code in target.lacks):
            does = "refuses" if refused else "takes"
            raise EmulationError(f"the emulated {processor} {does} {code.hex()}: wrong Unicorn version?")
