"""Cycles of each instruction, as a range: an estimate from the processors' manuals.

Zero wait states, no contention on the bus. What the manuals leave open is a range: whether a branch is taken
and how long the pipeline refills (P, 1 to 3), how early a division ends, whether a load is pipelined with its
neighbour, whether IT is folded. On a Cortex-M0+ the fast multiplier (1 cycle) is assumed, not the small one
(32).

RV32IMC is an instruction set, not a core: its cycles are those of a Hazard3, one core among many. There a
mispredicted branch takes a cycle more, and one more if its target is a 32-bit instruction across two words.

Sources: the instruction tables of the Cortex-M0+ (DDI 0484), Cortex-M3 (DDI 0337) and Cortex-M4 (DDI 0439)
technical reference manuals; of the Hazard3, section 3.8.7 of the RP2350 datasheet.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

PC = 15


class Cycles(NamedTuple):
    """Least and most cycles."""

    low: int
    high: int


@dataclass(frozen=True, slots=True)
class Rule:
    """Cycles of the instructions that equal `value` under `mask`; the first rule that fits counts.

    `counted` is the mask of a register list: each register adds a cycle.
    """

    mask: int
    value: int
    low: int
    high: int
    counted: int = 0


class Table(NamedTuple):
    """How an instruction is read at an offset (its word, whether it is wide), and the rules of each width."""

    read: Callable[[bytes, int], tuple[int, bool]]
    narrow: tuple[Rule, ...]
    wide: tuple[Rule, ...]


def _read_thumb(code: bytes, at: int) -> tuple[int, bool]:
    first = int.from_bytes(code[at : at + 2], "little")
    if first >> 11 not in (0b11101, 0b11110, 0b11111):
        return first, False
    return first << 16 | int.from_bytes(code[at + 2 : at + 4], "little"), True


def _read_riscv(code: bytes, at: int) -> tuple[int, bool]:
    wide = code[at] & 3 == 3
    return int.from_bytes(code[at : at + (4 if wide else 2)], "little"), wide


_M0PLUS = Table(
    _read_thumb,
    narrow=(
        Rule(0xFF00, 0xBD00, 3, 3, 0x00FF),  # POP with PC: 3 + N, PC not counted
        Rule(0xFE00, 0xBC00, 1, 1, 0x00FF),  # POP
        Rule(0xFE00, 0xB400, 1, 1, 0x01FF),  # PUSH
        Rule(0xF000, 0xC000, 1, 1, 0x00FF),  # LDM, STM
        Rule(0xF800, 0x4800, 2, 2),  # LDR literal
        Rule(0xF000, 0x5000, 2, 2),  # loads and stores, register offset
        Rule(0xE000, 0x6000, 2, 2),  # word and byte, immediate
        Rule(0xE000, 0x8000, 2, 2),  # halfword, relative to SP
        Rule(0xFF00, 0xDE00, 1, 1),  # UDF
        Rule(0xF000, 0xD000, 1, 2),  # B conditional
        Rule(0xF800, 0xE000, 2, 2),  # B
        Rule(0xFF00, 0x4700, 2, 2),  # BX, BLX
        Rule(0xFF87, 0x4487, 2, 2),  # ADD to PC
        Rule(0xFF87, 0x4687, 2, 2),  # MOV to PC
        Rule(0x0000, 0x0000, 1, 1),
    ),
    wide=(Rule(0xF800_D000, 0xF000_D000, 3, 3), Rule(0, 0, 3, 4)),  # BL; barriers, MRS, MSR
)

_P_LOW, _P_HIGH = 1, 3


def _mainline(multiply_accumulate: Cycles, long_multiply: Cycles, long_accumulate: Cycles) -> Table:
    return Table(
        _read_thumb,
        narrow=(
            Rule(0xFF00, 0xBD00, 2 + _P_LOW, 2 + _P_HIGH, 0x00FF),  # POP with PC: 1 + N + P
            Rule(0xFE00, 0xBC00, 1, 1, 0x00FF),  # POP
            Rule(0xFE00, 0xB400, 1, 1, 0x01FF),  # PUSH
            Rule(0xF000, 0xC000, 1, 1, 0x00FF),  # LDM, STM
            Rule(0xFF00, 0xBF00, 0, 1),  # IT and hints
            Rule(0xF500, 0xB100, 1, 1 + _P_HIGH),  # CBZ, CBNZ
            Rule(0xF800, 0x6000, 1, 1),  # STR immediate
            Rule(0xF800, 0x4800, 1, 2),  # LDR literal
            Rule(0xF000, 0x5000, 1, 2),  # loads and stores, register offset
            Rule(0xE000, 0x6000, 1, 2),  # word and byte, immediate
            Rule(0xE000, 0x8000, 1, 2),  # halfword, relative to SP
            Rule(0xF000, 0xD000, 1, 1 + _P_HIGH),  # B conditional
            Rule(0xF800, 0xE000, 1 + _P_LOW, 1 + _P_HIGH),  # B
            Rule(0xFF00, 0x4700, 1 + _P_LOW, 1 + _P_HIGH),  # BX, BLX
            Rule(0xFF87, 0x4487, 1 + _P_LOW, 1 + _P_HIGH),  # ADD to PC
            Rule(0xFF87, 0x4687, 1 + _P_LOW, 1 + _P_HIGH),  # MOV to PC
            Rule(0x0000, 0x0000, 1, 1),
        ),
        wide=(
            Rule(0xFFF0_FFE0, 0xE8D0_F000, 2 + _P_LOW, 2 + _P_HIGH),  # TBB, TBH
            Rule(0xFE50_8000, 0xE810_8000, 1 + _P_LOW, 1 + _P_HIGH, 0xFFFF),  # LDM with PC
            Rule(0xFE40_0000, 0xE800_0000, 1, 1, 0xFFFF),  # LDM, STM, PUSH, POP
            Rule(0xFE40_0000, 0xE840_0000, 3, 3),  # LDRD, STRD: 1 + N
            Rule(0xFFF0_F0F0, 0xFB90_F0F0, 2, 12),  # SDIV
            Rule(0xFFF0_F0F0, 0xFBB0_F0F0, 2, 12),  # UDIV
            Rule(0xFFD0_00F0, 0xFB80_0000, *long_multiply),  # SMULL, UMULL
            Rule(0xFF90_0000, 0xFB80_0000, *long_accumulate),  # SMLAL, UMLAL, SMLALxy
            Rule(0xFFF0_F0F0, 0xFB00_F000, 1, 1),  # MUL
            Rule(0xFF80_0000, 0xFB00_0000, *multiply_accumulate),  # MLA, MLS
            Rule(0xFFF0_0000, 0xF8C0_0000, 1, 1),  # STR immediate
            Rule(0xFE00_0000, 0xF800_0000, 1, 2),  # other loads and stores
            Rule(0xF800_D000, 0xF000_D000, 1 + _P_LOW, 1 + _P_HIGH),  # BL
            Rule(0xF800_D000, 0xF000_9000, 1 + _P_LOW, 1 + _P_HIGH),  # B
            Rule(0xFB80_D000, 0xF380_8000, 1, 4),  # barriers, MRS, MSR
            Rule(0xF800_D000, 0xF000_8000, 1, 1 + _P_HIGH),  # B conditional
            Rule(0x0000_0000, 0x0000_0000, 1, 1),
        ),
    )


_JUMP, _BRANCH, _LOAD = Cycles(2, 3), Cycles(1, 3), Cycles(1, 2)
_HAZARD3 = Table(
    _read_riscv,
    narrow=(
        Rule(0xE003, 0x4000, *_LOAD),  # C.LW
        Rule(0xE003, 0x4002, *_LOAD),  # C.LWSP
        Rule(0xE003, 0xC000, 1, 1),  # C.SW
        Rule(0xE003, 0xC002, 1, 1),  # C.SWSP
        Rule(0x6003, 0x2001, *_JUMP),  # C.J, C.JAL
        Rule(0xC003, 0xC001, *_BRANCH),  # C.BEQZ, C.BNEZ
        Rule(0xE07F, 0x8002, *_JUMP),  # C.JR, C.JALR
        Rule(0xE003, 0x8002, 1, 1),  # C.MV, C.ADD
        Rule(0xE003, 0x0000, 1, 1),  # C.ADDI4SPN
        Rule(0x8003, 0x0001, 1, 1),  # C.ADDI, C.LI, C.LUI, C.ADDI16SP
        Rule(0xE003, 0x8001, 1, 1),  # C.SRLI, C.SRAI, C.ANDI, C.SUB, C.XOR, C.OR, C.AND
        Rule(0xE003, 0x0002, 1, 1),  # C.SLLI
    ),
    wide=(
        Rule(0x0000_007F, 0x0000_0003, *_LOAD),
        Rule(0x0000_007F, 0x0000_0023, 1, 1),  # stores
        Rule(0x0000_007F, 0x0000_0063, *_BRANCH),
        Rule(0x0000_0077, 0x0000_0067, *_JUMP),  # JAL, JALR
        Rule(0xFE00_507F, 0x0200_4033, 18, 19),  # DIV, REM
        Rule(0xFE00_507F, 0x0200_5033, 18, 18),  # DIVU, REMU
        Rule(0xFE00_007F, 0x0200_0033, 1, 1),  # MUL, MULH, MULHSU, MULHU
        Rule(0xBE00_007F, 0x0000_0033, 1, 1),  # between registers
        Rule(0x0000_007F, 0x0000_0013, 1, 1),  # with an immediate operand
        Rule(0x0000_005F, 0x0000_0017, 1, 1),  # LUI, AUIPC
    ),
)

TABLES = {
    "cortex-m0plus": _M0PLUS,
    "cortex-m3": _mainline(Cycles(2, 2), Cycles(3, 5), Cycles(4, 7)),
    "cortex-m4": _mainline(Cycles(1, 2), Cycles(1, 1), Cycles(1, 1)),
    "rv32imc": _HAZARD3,
}


class Cost(NamedTuple):
    """What a piece of straight code costs: instructions, and the range of cycles."""

    instructions: int
    low: int
    high: int


def cost_of(code: bytes, processor: str) -> Cost:
    """Return the cost of a basic block.

    Parameters
    ----------
    code : bytes
        Whole instructions.
    processor : str
        One of `TABLES`.

    Raises
    ------
    ValueError
        If an instruction is none of the processor's.
    """
    table = TABLES[processor]
    instructions = low = high = at = 0
    while at < len(code):
        word, wide = table.read(code, at)
        rules = table.wide if wide else table.narrow
        rule = next((rule for rule in rules if word & rule.mask == rule.value), None)
        if rule is None:
            raise ValueError(f"a {processor} has no instruction {word:#x}")
        listed = (word & rule.counted).bit_count()
        instructions, low, high = instructions + 1, low + rule.low + listed, high + rule.high + listed
        at += 4 if wide else 2
    return Cost(instructions, low, high)
