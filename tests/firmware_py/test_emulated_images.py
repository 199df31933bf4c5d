"""The committed images are those of the committed C; the emulator is the processor asked for."""

import hashlib
import json

import pytest

from firmware_py.emulated import machine
from firmware_py.emulated.cycles import TABLES, Cost, cost_of
from firmware_py.emulated.image import IMAGES, MANIFEST, RAM, reference_image, source_digest
from firmware_py.emulated.machine import EmulationError, Machine
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


def test_an_emulator_that_takes_too_much_is_refused(monkeypatch):
    monkeypatch.setitem(machine.MODELS, "cortex-m0plus", machine.MODELS["cortex-m4"])
    with pytest.raises(EmulationError, match="cortex-m0plus takes"):
        Machine("cortex-m0plus", reference_image("cortex-m0plus"))


def test_an_emulator_that_takes_too_little_is_refused(monkeypatch):
    monkeypatch.setitem(machine.MODELS, "cortex-m4", machine.MODELS["cortex-m3"])
    with pytest.raises(EmulationError, match="cortex-m4 refuses"):
        Machine("cortex-m4", reference_image("cortex-m4"))


def test_the_program_of_another_processor_is_refused():
    emulated = Machine("cortex-m0plus", reference_image("cortex-m4"))
    with pytest.raises(EmulationError, match="cortex-m0plus"):
        emulated.call("timer_handler")


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
    ],
)
def test_cycles_are_those_of_the_manuals(processor, code, low, high):
    assert cost_of(bytes.fromhex(CODES[code]), processor) == Cost(1, low, high)


@pytest.mark.parametrize("processor", TABLES)
def test_a_block_costs_the_sum_of_its_instructions(processor):
    names = [name for name in CODES if processor != "cortex-m0plus" or len(CODES[name]) == 4]
    one_by_one = [cost_of(bytes.fromhex(CODES[name]), processor) for name in names]
    together = cost_of(bytes.fromhex("".join(CODES[name] for name in names)), processor)
    assert together == Cost(*map(sum, zip(*one_by_one, strict=True)))
