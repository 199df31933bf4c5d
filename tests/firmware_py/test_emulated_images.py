"""The committed images are those of the committed C; the emulator is the processor asked for."""

import hashlib
import json
from dataclasses import replace

import pytest

from firmware_py.emulated.cycles import TABLES, Cost, cost_of
from firmware_py.emulated.image import IMAGES, MANIFEST, RAM, reference_image, source_digest
from firmware_py.emulated.machine import FLASH, EmulationError, Machine
from firmware_py.emulated.processors import TARGETS

CODES = {
    "movs r0, #1": "0120",
    "muls r0, r1": "4843",
    "push {r4, lr}": "10b5",
    "pop {r4, pc}": "10bd",
    "ldr r0, [r1]": "0868",
    "str r0, [r1]": "0860",
    "b .": "fee7",
    "beq .": "fed0",
    "bl": "00f000f8",
    "it eq": "08bf",
    "udiv r0, r1, r2": "b1fbf2f0",
    "umull r0, r1, r2, r3": "a2fb0301",
    "smull r0, r1, r2, r3": "82fb0301",
    "mla r0, r1, r2, r3": "01fb0230",
    "mul r0, r1, r2": "01fb02f0",
    "ldrd r0, r1, [r2]": "d2e90001",
    "push {r4-r8, lr}": "2de9f041",
    "add.w r0, r1, r2": "01eb0200",
}
RISCV_CODES = {
    "c.addi a0, 1": "0505",
    "c.addi4spn a0, sp, 4": "4800",
    "c.li a0, 1": "0545",
    "c.lui a0, 1": "0565",
    "c.and a0, a1": "6d8d",
    "c.slli a0, 1": "0605",
    "c.mv a0, a1": "2e85",
    "c.lw a0, 0(a1)": "8841",
    "c.lwsp a0, 0(sp)": "0245",
    "c.sw a0, 0(a1)": "88c1",
    "c.swsp a0, 0(sp)": "2ac0",
    "c.j .": "01a0",
    "c.jal .": "0120",
    "c.jr ra": "8280",
    "c.beqz a0, .": "01c1",
    "lw a0, 0(a1)": "03a50500",
    "sw a0, 0(a1)": "23a0a500",
    "beq a0, a1, .": "6300b500",
    "jal .": "ef000000",
    "jalr a1": "e7800500",
    "mul a0, a0, a1": "3305b502",
    "mulhu a0, a0, a1": "3335b502",
    "div a0, a0, a1": "3345b502",
    "divu a0, a0, a1": "3355b502",
    "sub a0, a0, a1": "3305b540",
    "addi a0, a0, 1": "13051500",
    "lui a0, 1": "37150000",
}
CODES_OF = {processor: CODES if processor.startswith("cortex") else RISCV_CODES for processor in TABLES}


def test_the_images_were_built_from_what_is_committed():
    manifest = json.loads(MANIFEST.read_text())
    assert manifest["sources_sha256"] == source_digest(), "run make elf"
    for processor in TARGETS:
        contents = (IMAGES / f"{processor}.elf").read_bytes()
        assert hashlib.sha256(contents).hexdigest() == manifest["images"][processor]["sha256"]
        assert len(contents) < 32_768


@pytest.mark.parametrize("processor", TARGETS)
def test_power_on_ends_in_the_idle_loop(processor):
    image = reference_image(processor)
    emulated = Machine(processor, image)
    emulated.paint_stack()
    emulated.start()
    assert 0 < emulated.stack_bytes() < 512
    assert image.ram_bytes + 512 < RAM[1]


@pytest.mark.parametrize(
    ("processor", "model"),
    [("cortex-m0plus", "ARM_CORTEX_M4"), ("cortex-m3", "ARM_CORTEX_M4"), ("rv32imc", "RISCV32_SIFIVE_U34")],
)
def test_an_emulator_that_takes_too_much_is_refused(monkeypatch, processor, model):
    monkeypatch.setitem(TARGETS, processor, replace(TARGETS[processor], model=model))
    with pytest.raises(EmulationError, match=f"{processor} takes"):
        Machine(processor, reference_image(processor))


def test_an_emulator_that_takes_too_little_is_refused(monkeypatch):
    monkeypatch.setitem(TARGETS, "cortex-m4", replace(TARGETS["cortex-m4"], model="ARM_CORTEX_M3"))
    with pytest.raises(EmulationError, match="cortex-m4 refuses"):
        Machine("cortex-m4", reference_image("cortex-m4"))


@pytest.mark.parametrize(("processor", "other"), [("cortex-m0plus", "cortex-m4"), ("rv32imc", "cortex-m4")])
def test_the_program_of_another_processor_is_refused(processor, other):
    emulated = Machine(processor, reference_image(other))
    with pytest.raises(EmulationError, match=processor):
        emulated.call("timer_handler")


def test_a_riscv_begins_at_its_first_instruction_and_gives_itself_a_stack():
    image = reference_image("rv32imc")
    emulated = Machine("rv32imc", replace(image, symbols={**image.symbols, "stack_top": 0}))
    assert image.symbols["reset_handler"] == FLASH[0]
    emulated.start()


@pytest.mark.parametrize(
    ("processor", "code", "low", "high"),
    [
        ("cortex-m4", "movs r0, #1", 1, 1),
        ("cortex-m4", "push {r4, lr}", 3, 3),
        ("cortex-m4", "push {r4-r8, lr}", 7, 7),
        ("cortex-m4", "pop {r4, pc}", 4, 6),
        ("cortex-m4", "ldr r0, [r1]", 1, 2),
        ("cortex-m4", "str r0, [r1]", 1, 1),
        ("cortex-m4", "b .", 2, 4),
        ("cortex-m4", "beq .", 1, 4),
        ("cortex-m4", "bl", 2, 4),
        ("cortex-m4", "it eq", 0, 1),
        ("cortex-m4", "udiv r0, r1, r2", 2, 12),
        ("cortex-m4", "umull r0, r1, r2, r3", 1, 1),
        ("cortex-m4", "mul r0, r1, r2", 1, 1),
        ("cortex-m4", "mla r0, r1, r2, r3", 1, 2),
        ("cortex-m4", "ldrd r0, r1, [r2]", 3, 3),
        ("cortex-m4", "add.w r0, r1, r2", 1, 1),
        ("cortex-m3", "umull r0, r1, r2, r3", 3, 5),
        ("cortex-m3", "smull r0, r1, r2, r3", 3, 5),
        ("cortex-m3", "mla r0, r1, r2, r3", 2, 2),
        ("cortex-m0plus", "muls r0, r1", 1, 1),
        ("cortex-m0plus", "push {r4, lr}", 3, 3),
        ("cortex-m0plus", "pop {r4, pc}", 4, 4),
        ("cortex-m0plus", "ldr r0, [r1]", 2, 2),
        ("cortex-m0plus", "b .", 2, 2),
        ("cortex-m0plus", "beq .", 1, 2),
        ("cortex-m0plus", "bl", 3, 3),
        ("rv32imc", "c.addi a0, 1", 1, 1),
        ("rv32imc", "c.addi4spn a0, sp, 4", 1, 1),
        ("rv32imc", "c.li a0, 1", 1, 1),
        ("rv32imc", "c.lui a0, 1", 1, 1),
        ("rv32imc", "c.and a0, a1", 1, 1),
        ("rv32imc", "c.slli a0, 1", 1, 1),
        ("rv32imc", "c.mv a0, a1", 1, 1),
        ("rv32imc", "c.lw a0, 0(a1)", 1, 2),
        ("rv32imc", "c.lwsp a0, 0(sp)", 1, 2),
        ("rv32imc", "c.sw a0, 0(a1)", 1, 1),
        ("rv32imc", "c.swsp a0, 0(sp)", 1, 1),
        ("rv32imc", "c.j .", 2, 3),
        ("rv32imc", "c.jal .", 2, 3),
        ("rv32imc", "c.jr ra", 2, 3),
        ("rv32imc", "c.beqz a0, .", 1, 3),
        ("rv32imc", "lw a0, 0(a1)", 1, 2),
        ("rv32imc", "sw a0, 0(a1)", 1, 1),
        ("rv32imc", "beq a0, a1, .", 1, 3),
        ("rv32imc", "jal .", 2, 3),
        ("rv32imc", "jalr a1", 2, 3),
        ("rv32imc", "mul a0, a0, a1", 1, 1),
        ("rv32imc", "mulhu a0, a0, a1", 1, 1),
        ("rv32imc", "div a0, a0, a1", 18, 19),
        ("rv32imc", "divu a0, a0, a1", 18, 18),
        ("rv32imc", "sub a0, a0, a1", 1, 1),
        ("rv32imc", "addi a0, a0, 1", 1, 1),
        ("rv32imc", "lui a0, 1", 1, 1),
    ],
)
def test_cycles_are_those_of_the_manuals(processor, code, low, high):
    assert cost_of(bytes.fromhex(CODES_OF[processor][code]), processor) == Cost(1, low, high)


@pytest.mark.parametrize("code", ["2fa5a500", "53f5b500", "8860", "8821"])  # amoadd.w, fadd.s, c.flw, c.fld
def test_what_rv32imc_has_not_costs_nothing_but_an_error(code):
    with pytest.raises(ValueError, match="a rv32imc has no instruction"):
        cost_of(bytes.fromhex(code), "rv32imc")


@pytest.mark.parametrize("processor", TABLES)
def test_a_block_costs_the_sum_of_its_instructions(processor):
    codes = [code for code in CODES_OF[processor].values() if processor != "cortex-m0plus" or len(code) == 4]
    one_by_one = [cost_of(bytes.fromhex(code), processor) for code in codes]
    together = cost_of(bytes.fromhex("".join(codes)), processor)
    assert together == Cost(*map(sum, zip(*one_by_one, strict=True)))
