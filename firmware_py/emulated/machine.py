"""A Cortex-M in Unicorn: memory, calls, and what they cost.

It has no NVIC and no SysTick: whoever uses it calls the handlers. The Unicorn engine is licensed under the
GPL, version 2: it is an optional extra, and nothing of it is part of this package.
"""

from collections.abc import Iterable
from struct import pack, unpack

import unicorn.arm_const as arm
from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_THUMB, UC_PROT_ALL, Uc, UcError

from firmware_py.emulated.cycles import Cost, cost_of
from firmware_py.emulated.image import RAM, Image

MODELS = {  # a Cortex-M0+ has the instructions of a Cortex-M0
    "cortex-m0plus": arm.UC_CPU_ARM_CORTEX_M0,
    "cortex-m3": arm.UC_CPU_ARM_CORTEX_M3,
    "cortex-m4": arm.UC_CPU_ARM_CORTEX_M4,
}
FLASH = 0x08000000, 0x20000
SCRATCH = 0x60000000, 0x400000
"""Memory that no real part has: for what tests exchange with the program."""
PERIPHERALS = 0x40006000, 0x1000
_RETURN = 0x0FFF_F000
"""Where calls return to; nothing else lies in its page."""

_SMULL, _QADD, _NOP = b"\x82\xfb\x03\x01", b"\x82\xfa\x81\xf0", b"\x00\xbf\x00\xbf"
_REFUSED = {"cortex-m0plus": (_SMULL, _QADD), "cortex-m3": (_QADD,), "cortex-m4": ()}
_PAINT = 0xC5
_ARGUMENTS = arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2, arm.UC_ARM_REG_R3


class EmulationError(Exception):
    """The program did what the processor refuses, or the emulator is not the processor asked for."""


class Machine:
    """A processor with a program in its memory.

    Parameters
    ----------
    processor : str
        One of `MODELS`.
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
        _self_test(processor)
        self._uc = _new_processor(processor)
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
        self._uc.reg_write(arm.UC_ARM_REG_SP, self.image.symbols["stack_top"])
        self._run(self.image.symbols["reset_handler"], self.image.symbols["idle"])

    def call(self, function: str, *arguments: int) -> int:
        """Call a function by its symbol, as an interrupt would; return its result."""
        for register, value in zip(_ARGUMENTS, arguments, strict=False):
            self._uc.reg_write(register, value)
        self._uc.reg_write(arm.UC_ARM_REG_SP, self.image.symbols["stack_top"])
        self._uc.reg_write(arm.UC_ARM_REG_LR, _RETURN | 1)
        self._run(self.image.symbols[function], _RETURN)
        return int(self._uc.reg_read(arm.UC_ARM_REG_R0))

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
            self._uc.emu_start(begin | 1, end)
        except UcError as error:
            at = self._uc.reg_read(arm.UC_ARM_REG_PC)
            raise EmulationError(f"{self._processor}: {error} at {at:#010x}") from error
        self.cost = Cost(*map(sum, zip(*self._counted, strict=True))) if self._counted else Cost(0, 0, 0)

    def _enter_block(self, uc: Uc, address: int, size: int, _: object) -> None:
        cost = self._blocks.get((address, size))
        if cost is None:
            cost = self._blocks[address, size] = cost_of(bytes(uc.mem_read(address, size)), self._processor)
        self._counted.append(cost)


def _new_processor(processor: str) -> Uc:
    uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB)  # with UC_MODE_MCLASS it would be a Cortex-M33 whatever is asked for
    uc.ctl_set_cpu_model(MODELS[processor])
    return uc


def _self_test(processor: str) -> None:
    """Make sure that the emulator is the processor asked for."""
    for instruction in (_SMULL, _QADD, _NOP):
        uc = _new_processor(processor)
        uc.mem_map(FLASH[0], 0x1000, UC_PROT_ALL)
        uc.mem_write(FLASH[0], instruction + _NOP)
        try:
            uc.emu_start(FLASH[0] | 1, FLASH[0] + len(instruction))
            refused = False
        except UcError:
            refused = True
        if refused != (instruction in _REFUSED[processor]):
            does = "refuses" if refused else "takes"
            raise EmulationError(
                f"the emulated {processor} {does} {instruction.hex()}: wrong Unicorn version?"
            )
