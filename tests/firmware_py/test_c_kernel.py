"""The exported C is the kernel: the same bits as on its other machines, and nothing undefined on the way."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from c_builds import BUILDS, EXPORTED, compiled, output_of
from kernel_runs import CASES, step_through
from kernel_segments import Segment, run_compiled, segments

from dbc.contract import Contract
from firmware_py.c_export.files import export
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.compiled import control_reset, control_step
from firmware_py.kernel import layout as k
from firmware_py.kernel_check import MACHINE, analyse, firmware_sources
from firmware_py.tuning import TUNINGS

HERE = Path(__file__).parent
INT32_MIN, INT32_MAX = -(2**31), 2**31 - 1


@pytest.fixture(scope="session", params=BUILDS)
def kernel_program(request, tmp_path_factory):
    """The kernel behind a pipe."""
    program = tmp_path_factory.mktemp("c") / f"kernel-{request.param}"
    return compiled(
        program, [HERE / "kernel_driver.c", *sorted(EXPORTED.glob("*.c"))], *BUILDS[request.param]
    )


def test_what_is_committed_is_what_would_be_exported():
    committed = {path.name: path.read_text() for path in EXPORTED.iterdir()}
    assert export(chosen_tuning(), Contract.load()) == committed, "run make c"


@pytest.mark.parametrize("name", TUNINGS)
def test_of_another_tuning_only_the_calibration_differs(name, tmp_path):
    files = export(chosen_tuning(name), Contract.load())
    calibration = tmp_path / "ddh_calibration.c"
    calibration.write_text(files.pop(calibration.name))
    assert files == {file: (EXPORTED / file).read_text() for file in files}
    compiled(tmp_path / "calibration.o", [calibration], "-c")


def test_there_is_no_float_and_no_allocation():
    for file in EXPORTED.iterdir():
        assert not re.search(r"\b(float|double|malloc|alloca)\b", file.read_text())


def assert_same_steps(program, played):
    """Play segments, some thousand steps at a time."""
    played = iter(played)
    while chunk := list(itertools.islice(played, 1000)):
        words, expected = [], []
        for segment in chunk:
            words += [len(segment.setpoints), segment.law, *segment.calibration.words]
            words += np.column_stack((segment.setpoints, segment.positions)).ravel().tolist()
            expected.append(np.hstack(run_compiled(segment)))
        steps = np.frombuffer(output_of(program, np.array(words, np.int32)), np.int32)
        np.testing.assert_array_equal(steps.reshape(-1, k.ST_SIZE + k.IO_SIZE), np.vstack(expected))


def test_a_hundred_thousand_steps(kernel_program):
    assert_same_steps(kernel_program, segments(100_000, seed=20201120))


@pytest.mark.long
def test_a_million_steps(kernel_program):
    assert_same_steps(kernel_program, segments(1_000_000, seed=64))


@pytest.fixture(scope="session")
def closed_loop():
    """What the controller was fed in a closed loop, under each law."""
    played, calibration = [], chosen_tuning().calibration
    for name, law in itertools.product(("sine", "lift_lower_load"), range(k.LAW_P, k.LAW_SCHEDULED + 1)):
        inputs = []

        def make_controller(position, law=law, inputs=inputs):
            words = calibration.array()
            state, io = np.zeros(k.ST_SIZE, np.int32), np.zeros(k.IO_SIZE, np.int32)
            io[k.IO_LAW], io[k.IO_POSITION] = law, position
            control_reset(words, state, io)

            def step(setpoint, position):
                inputs.append((setpoint, position))
                io[k.IO_SETPOINT], io[k.IO_POSITION] = setpoint, position
                control_step(words, state, io)
                return int(io[k.IO_TARGET_VELOCITY])

            return step

        step_through(CASES[name], make_controller)
        setpoints, positions = np.array(inputs, np.int32).T
        played.append(Segment(calibration, law, setpoints, positions))
    return played


def test_closed_loop(kernel_program, closed_loop):
    assert sum(len(segment.setpoints) for segment in closed_loop) > 100_000
    assert_same_steps(kernel_program, closed_loop)


ROOTS = [1, 2, 3, 46340, 46341, 2**31 - 1, 2**31, 3037000499]
AROUND_SQUARES = [
    square + offset
    for square in [*(4**n for n in range(31)), *(root**2 for root in ROOTS)]
    for offset in (-1, 0, 1)
]
WIDE = [
    0,
    1,
    -1,
    2,
    -2,
    3,
    -3,
    INT32_MAX,
    INT32_MIN,
    INT32_MAX + 1,
    INT32_MIN - 1,
    2**62,
    -(2**62),
    2**63 - 1,
]
NARROW = [0, 1, -1, 2, -2, 3, INT32_MAX, INT32_MIN, INT32_MIN + 1, 1000, -1000, 1001, -1001, 999]
DELTAS = [1, 2, 3, 1000, INT32_MAX - 1, INT32_MAX]
SHIFTS = [1, 2, 7, 8, 31, 32, 33, 61, 62]
BRAKES = [1, 2, 3, 2**24]
GAPS = [0, 1, -1, 2, -2, 3, -3, 2**24, 2**24 + 1, -(2**24) - 1, 2**32, -(2**32), 2**33, -(2**33)]
POSITIVE = [1, 2, 3, 7, 2**24 - 1, 2**24, INT32_MAX, 2**32]
DIVISORS = [0, 1, 2, 3, 7, 2**16 - 1, 2**16, 2**30 - 1, 2**30, 2**30 + 2**15 - 1, INT32_MAX]
DIVIDENDS = [
    0,
    *(floor * divisor - 1 for floor in (1, 8, 2**16, INT32_MAX, 2**31) for divisor in DIVISORS[1:]),
]
HALF = [value for value in WIDE if abs(value) <= 2**62]

VECTORS = {
    "sat32": [WIDE],
    "absolute": [WIDE],
    "clamp": [WIDE, [value for value in WIDE if value >= 0]],
    "round_shift": [HALF, SHIFTS],
    "mul_q": [NARROW, NARROW, SHIFTS],
    "isqrt": [AROUND_SQUARES],
    "isqrt_61": [[value for value in AROUND_SQUARES if 0 < value < 2**61]],
    "log2_q22": [[*DELTAS, 127, 128, 129, 255, 256, 257, 2**30 - 1, 2**30]],
    "magnitude_of": [NARROW],
    "fal": [[*NARROW, *DELTAS, *(-delta for delta in DELTAS)], DELTAS, [0, 1, 2**15 - 1, 2**15, 2**22 - 1]],
    "approach": [GAPS, BRAKES],
    "switching_error": [[*GAPS, 2**34, -(2**34)], GAPS[:9], [1, 2**24, 2**25]],
    "quotient": [[*DIVIDENDS, *(dividend + 1 for dividend in DIVIDENDS)], DIVISORS],
    "column": [[1, 2, INT32_MAX], [0, *POSITIVE]],
    "softness": [DIVISORS],
    "scaled": [NARROW, NARROW],
    "metres_from_setpoint": [NARROW],
    "metres_from_position": [NARROW],
    "velocity_from_speed": [NARROW],
    "speed_from_velocity": [NARROW],
    "extract": [NARROW, NARROW, [0, 1, 16, 31, 32], [1, 8, 31], [0, 1]],
    "profile2_crc": [NARROW, NARROW, range(2, 9), [0, 1, 255]],
    "profile2_is_accepted": [range(256)],
    "next_state": [range(4), range(32)],
}
"""Values of each argument of each helper; all their combinations are tried."""

KINDS = {
    name: (module.rpartition(".")[2], signature.parameters)
    for module, analysed in analyse(firmware_sources())[0].items()
    for name, signature in analysed.functions.items()
    if module != MACHINE and set(signature.parameters) <= {32, 64} and signature.result is not None
}


def test_every_helper_on_numbers_has_its_vectors():
    assert KINDS.keys() == VECTORS.keys()


@pytest.fixture(scope="session", params=BUILDS)
def helper_program(request, tmp_path_factory):
    """All helpers behind a pipe: number of the helper and five arguments in, result out; int64."""
    directory = tmp_path_factory.mktemp("c")
    cases = []
    for number, name in enumerate(VECTORS):
        arguments = [f"(int{width}_t)words[{1 + i}]" for i, width in enumerate(KINDS[name][1])]
        cases.append(f"case {number}: result = {name}({', '.join(arguments)}); break;")
    source = directory / "helpers.c"
    source.write_text(
        f"""#include <stdio.h>
#include "{EXPORTED}/ddh_controller.c"
int main(void)
{{
    int64_t words[6];
    while (fread(words, sizeof words, 1, stdin) == 1) {{
        int64_t result = 0;
        switch (words[0]) {{
        {"".join(cases)}
        default: return 1;
        }}
        (void)fwrite(&result, sizeof result, 1, stdout);
    }}
    return 0;
}}
"""
    )
    return compiled(directory / "helpers", [source, EXPORTED / "ddh_calibration.c"], *BUILDS[request.param])


def test_helpers_at_the_ends_of_their_ranges(helper_program, kernel_modules):
    calls, expected = [], []
    for number, (name, values) in enumerate(VECTORS.items()):
        module, kinds = KINDS[name]
        function = getattr(kernel_modules[module], name)
        makers = [
            {32: kernel_modules["machine"].i32, 64: kernel_modules["machine"].i64}[kind] for kind in kinds
        ]
        for arguments in itertools.product(*values):
            calls.append((number, *arguments, *(5 - len(arguments)) * (0,)))
            expected.append(
                int(function(*(make(value) for make, value in zip(makers, arguments, strict=True))))
            )
    results = np.frombuffer(output_of(helper_program, np.array(calls, np.int64)), np.int64)
    np.testing.assert_array_equal(results, expected)
