"""The processors that are emulated, and the compilers that build for them."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InstructionSet:
    """What processors with the same instructions have in common.

    Attributes
    ----------
    zig : tuple of str
        What zig is told of it.
    gcc : tuple of str
        gcc's command for it, and what it is told of it.
    sources : tuple of str
        Files of `firmware_py/target` that only it needs.
    architecture, mode : str
        Its name in Unicorn.
    arguments : tuple of str
        Registers of a call's arguments, by Unicorn's names; the first one returns the result.
    stack_pointer, return_address : str
        Registers.
    code_bit : int
        Set in an address that is jumped to.
    """

    zig: tuple[str, ...]
    gcc: tuple[str, ...]
    sources: tuple[str, ...]
    architecture: str
    mode: str
    arguments: tuple[str, ...]
    stack_pointer: str
    return_address: str
    code_bit: int


THUMB = InstructionSet(
    zig=("-target", "thumb-freestanding-eabi"),
    gcc=("arm-none-eabi-gcc", "-mthumb"),
    sources=("cortex_m.c",),
    architecture="ARM",
    mode="THUMB",  # with MCLASS it would be a Cortex-M33 whatever is asked for
    arguments=("R0", "R1", "R2", "R3"),
    stack_pointer="SP",
    return_address="LR",
    code_bit=1,
)
RISCV = InstructionSet(
    zig=("-target", "riscv32-freestanding-none"),
    gcc=("riscv64-unknown-elf-gcc", "-mabi=ilp32"),
    sources=("riscv.c",),
    architecture="RISCV",
    mode="RISCV32",
    arguments=("A0", "A1", "A2", "A3"),
    stack_pointer="SP",
    return_address="RA",
    code_bit=0,
)


@dataclass(frozen=True, slots=True)
class Target:
    """A processor.

    Attributes
    ----------
    instructions : InstructionSet
        Which one it has.
    zig, gcc : str
        What the compilers are told of it.
    model : str
        Unicorn's name of the processor that is emulated in its place.
    clock_mhz : float
        A clock that is usual for it.
    has, lacks : tuple of bytes
        Code that it takes, and code that it must refuse.
    sources : tuple of str
        Files of `firmware_py/target` that only it needs.
    """

    instructions: InstructionSet
    zig: str
    gcc: str
    model: str
    clock_mhz: float
    has: tuple[bytes, ...]
    lacks: tuple[bytes, ...]
    sources: tuple[str, ...] = ()


_NOP, _SMULL, _QADD = (bytes.fromhex(code) for code in ("00bf", "82fb0301", "82fa81f0"))
_C_ADDI, _MULHU, _DIVU = (bytes.fromhex(code) for code in ("0505", "33b5b502", "3355b502"))
_FLOATS_ON = bytes.fromhex("b765000073a00530")  # lui a1, 6; csrs mstatus, a1
_FADD_S, _FADD_D = (_FLOATS_ON + bytes.fromhex(code) for code in ("53f5b500", "53f5b502"))
_SH1ADD, _ADDW = (bytes.fromhex(code) for code in ("3325b520", "3b05b500"))

TARGETS = {
    "cortex-m0plus": Target(
        THUMB,
        zig="-mcpu=cortex_m0plus",
        gcc="-mcpu=cortex-m0plus",
        model="ARM_CORTEX_M0",  # the same instructions
        clock_mhz=48.0,
        has=(_NOP,),
        lacks=(_SMULL, _QADD),
        sources=("divide.c",),
    ),
    "cortex-m3": Target(
        THUMB,
        zig="-mcpu=cortex_m3",
        gcc="-mcpu=cortex-m3",
        model="ARM_CORTEX_M3",
        clock_mhz=72.0,
        has=(_NOP, _SMULL),
        lacks=(_QADD,),
    ),
    "cortex-m4": Target(
        THUMB,
        zig="-mcpu=cortex_m4",
        gcc="-mcpu=cortex-m4",
        model="ARM_CORTEX_M4",
        clock_mhz=168.0,
        has=(_NOP, _SMULL, _QADD),
        lacks=(),
    ),
    "rv32imc": Target(
        RISCV,
        zig="-mcpu=generic_rv32+m+c",
        gcc="-march=rv32imc",
        model="RISCV32_SIFIVE_E31",  # it has atomics as well
        clock_mhz=150.0,
        has=(_C_ADDI, _MULHU, _DIVU),
        lacks=(_FADD_S, _FADD_D, _SH1ADD, _ADDW),
    ),
}
COMPILERS = ("zig", "gcc")
