"""With a damaged calibration flashed, the firmware moves nothing, whatever it is compiled to."""

import random
import re
import struct
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest
from c_builds import BUILDS, EXPORTED, compiled, output_of
from damaged_blocks import BLOCK, DAMAGED, ILLEGAL_WORDS, resealed, with_words
from firmware_events import CONTRACT, Senders
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_runs import traffic_under

from dbc.node import PERIOD_NS
from firmware_py import checked
from firmware_py.calibration import BLOCK_BYTES, flashed
from firmware_py.calibration_block import law_of_block
from firmware_py.chosen_firmware import PROCESSORS
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.diagnosis import Fault, State
from firmware_py.emulated.image import reference_image
from firmware_py.emulated.node import EmulatedController
from firmware_py.kernel import layout as k
from firmware_py.node import EXECUTION_NS, Controller
from firmware_py.tuning import TUNINGS, Tuning
from hil.scenario import load_scenario

DAMAGED_BLOCKS = [block for block, _ in DAMAGED] + [
    with_words({index: word}) for index, word, _ in ILLEGAL_WORDS
]
ENABLED = 0x1237


def emulated(block: bytes, processor: str) -> EmulatedController:
    return EmulatedController(CONTRACT, block, processor, reference_image(processor), EXECUTION_NS)


def asked_to_run(controller: Controller, periods: int = 20) -> list[tuple]:
    """What is sent in each period to a bus on which everything is well and movement is asked for."""
    senders = Senders()
    controller.on_start(0)
    sent = []
    for period in range(periods):
        for name, *values in (
            ("feedback", 0, 100_000),
            ("setpoint", 2_000_000),
            ("command", int(period >= 5), k.LAW_ADRC, period % 2),
            ("drive_status", ENABLED, 0),
        ):
            controller.on_frame(period * PERIOD_NS, senders.frame(name, *values))
        sent.append(controller.on_timer(period * PERIOD_NS).sends)
    return sent


def assert_stays_in_power_on(controller: Controller, periods: int = 20) -> list[tuple]:
    sent = asked_to_run(controller, periods)
    record = controller.record.columns_by_name()
    assert set(record["state"]) == {State.POWER_ON}
    assert set(record["faults"][3:]) == {Fault.CALIBRATION_INVALID}
    assert not record["target_velocity_0p25rpm"].any()
    return sent


@pytest.mark.parametrize("processor", PROCESSORS)
def test_with_a_good_block_the_same_bus_makes_it_run(processor):
    controller = emulated(BLOCK, processor)
    assert asked_to_run(controller) == asked_to_run(Controller(CONTRACT, BLOCK))
    record = controller.record.columns_by_name()
    assert record["state"][-1] == State.RUN
    assert record["target_velocity_0p25rpm"][-1] > 0


@pytest.mark.parametrize("processor", PROCESSORS)
@pytest.mark.parametrize("block", DAMAGED_BLOCKS)
def test_a_damaged_block_is_refused_on_a_processor_as_in_python(processor, block):
    on_processor = assert_stays_in_power_on(emulated(block, processor))
    assert on_processor == assert_stays_in_power_on(Controller(CONTRACT, block))


@given(bit=st.integers(0, 8 * BLOCK_BYTES - 1), processor=st.sampled_from(PROCESSORS))
@settings(max_examples=30)
def test_any_flipped_bit_is_refused_on_a_processor_as_in_python(bit, processor):
    block = (int.from_bytes(BLOCK, "little") ^ 1 << bit).to_bytes(BLOCK_BYTES, "little")
    on_processor = assert_stays_in_power_on(emulated(block, processor), periods=8)
    assert on_processor == assert_stays_in_power_on(Controller(CONTRACT, block), periods=8)


def test_a_damaged_block_commands_no_movement_and_leaves_the_same_bus():
    scenario = load_scenario("sine", 0.2)
    damaged = DAMAGED_BLOCKS[-1]
    python = traffic_under(Controller(CONTRACT, damaged), scenario)
    np.testing.assert_array_equal(traffic_under(emulated(damaged, "cortex-m4"), scenario), python)
    commands = python[python[:, 1] == CONTRACT.drive_command.can_id, 3]
    assert len(commands) > 200
    assert {CONTRACT.drive_command.unpack(int(data)).target_velocity for data in commands} == {0}


# bit for bit


@pytest.fixture(scope="session", params=BUILDS)
def check_program(request, tmp_path_factory):
    """The check behind a pipe: blocks in, the law of each out."""
    directory = tmp_path_factory.mktemp("c")
    source = directory / "check.c"
    source.write_text(
        f"""#include <stdio.h>
#include "{EXPORTED}/ddh_controller.c"
int main(void)
{{
    int32_t block[DDH_BLOCK_SIZE];
    while (fread(block, sizeof block, 1, stdin) == 1) {{
        int32_t law = law_of_block(block);
        (void)fwrite(&law, sizeof law, 1, stdout);
    }}
    return 0;
}}
"""
    )
    return compiled(directory / "check", [source, EXPORTED / "ddh_calibration.c"], *BUILDS[request.param])


@numba.njit
def law_by_numba(block):
    return law_of_block(block)


def any_blocks(count: int) -> list[bytes]:
    """Good blocks, damaged ones, and such whose words and header are anything under a CRC that fits."""
    rng = random.Random(3)
    blocks = [tuning.calibration().to_bytes() for tuning in TUNINGS.values()]
    blocks += [Tuning(law=law).calibration().to_bytes() for law in range(k.LAW_P, k.LAW_SCHEDULED + 1)]
    blocks += DAMAGED_BLOCKS
    for _ in range(count):
        place, word = 4 * rng.randrange(BLOCK_BYTES // 4), rng.getrandbits(32) >> rng.randrange(32)
        blocks.append(resealed(BLOCK[:place] + struct.pack("<I", word) + BLOCK[place + 4 :]))
    return [flashed(block) for block in blocks] + [rng.randbytes(BLOCK_BYTES) for _ in range(10)]


def test_the_check_is_the_same_on_all_machines(check_program, kernel_modules: dict[str, ModuleType]):
    blocks = any_blocks(400)
    words = np.array([np.frombuffer(block, "<i4") for block in blocks])
    in_python = [law_of_block(block) for block in words.tolist()]
    assert 100 < in_python.count(0) < len(blocks) - 100
    assert np.frombuffer(output_of(check_program, words), np.int32).tolist() == in_python
    assert [law_by_numba(block) for block in words] == in_python
    check = kernel_modules["calibration_block"].law_of_block
    assert [check(checked.CheckedArray(block)) for block in words.tolist()] == in_python


@pytest.mark.parametrize("processor", PROCESSORS)
def test_an_image_holds_the_block_as_flashed(processor):
    image = reference_image(processor)
    begin = image.symbols["ddh_calibration"]
    flash = {address + n: byte for address, data in image.segments for n, byte in enumerate(data)}
    block = bytes(flash[begin + n] for n in range(BLOCK_BYTES))
    assert block == chosen_tuning().calibration.to_bytes()


def test_the_damaged_block_in_the_documentation_is_refused(capsys):
    page = (Path(__file__).parents[2] / "docs/silicon.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(example, "docs/silicon.md", "exec"), {})
    assert capsys.readouterr().out.count("Frame(") == 2


SWITCH_ON_DISABLED, FAULT = 0x250, 0x218


@pytest.mark.parametrize(
    ("statusword", "fault_reset", "controlword"),
    [(SWITCH_ON_DISABLED, 0, 6), (ENABLED, 0, 6), (FAULT, 0, 0), (FAULT, 1, 0x80)],
)
def test_a_damaged_block_never_enables_the_drive(statusword, fault_reset, controlword):
    controller, senders = Controller(CONTRACT, DAMAGED_BLOCKS[0]), Senders()
    controller.on_start(0)
    sent = []
    for now_ns in (0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS):
        _, command = controller.on_timer(now_ns).sends[0]
        sent.append(command.data >> 16 & 0xFFFF)
        controller.on_frame(now_ns, senders.frame("drive_status", statusword, 0))
        controller.on_frame(now_ns, senders.frame("command", 1, k.LAW_ADRC, fault_reset))
    assert (sent[0], sent[-1]) == (0, controlword)
