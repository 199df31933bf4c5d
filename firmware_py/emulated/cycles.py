"""Cycles of each instruction, as a range: an estimate from Arm's technical reference manuals.

Zero wait states, no contention on the bus. What the manuals leave open is a range: whether a branch is taken
and how long the pipeline refills (P, 1 to 3), how early a division ends, whether a load is pipelined with its
neighbour, whether IT is folded. On a Cortex-M0+ the fast multiplier (1 cycle) is assumed, not the small one
(32).

Sources: the instruction tables of the Cortex-M0+ (DDI 0484), Cortex-M3 (DDI 0337) and Cortex-M4 (DDI 0439)
technical reference manuals.
"""

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


def _is_wide(halfword: int) -> bool:
    return halfword >> 11 in (0b11101, 0b11110, 0b11111)


_M0PLUS = {
    False: (
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
    True: (Rule(0xF800_D000, 0xF000_D000, 3, 3), Rule(0, 0, 3, 4)),  # BL; barriers, MRS, MSR
}

_P_LOW, _P_HIGH = 1, 3


def _mainline(
    multiply_accumulate: Cycles, long_multiply: Cycles, long_accumulate: Cycles
) -> dict[bool, tuple[Rule, ...]]:
    return {
        False: (
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
        True: (
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
    }


TABLES = {
    "cortex-m0plus": _M0PLUS,
    "cortex-m3": _mainline(Cycles(2, 2), Cycles(3, 5), Cycles(4, 7)),
    "cortex-m4": _mainline(Cycles(1, 2), Cycles(1, 1), Cycles(1, 1)),
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
        Whole Thumb instructions.
    processor : str
        One of `TABLES`.
    """
    table = TABLES[processor]
    instructions = low = high = at = 0
    while at < len(code):
        word = int.from_bytes(code[at : at + 2], "little")
        wide = _is_wide(word)
        if wide:
            word = word << 16 | int.from_bytes(code[at + 2 : at + 4], "little")
        rule = next(rule for rule in table[wide] if word & rule.mask == rule.value)
        listed = (word & rule.counted).bit_count()
        instructions, low, high = instructions + 1, low + rule.low + listed, high + rule.high + listed
        at += 4 if wide else 2
    return Cost(instructions, low, high)
