"""The exported C is the whole control task: the same frames, whatever it hears, and nothing undefined."""

import ctypes
import random
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from c_builds import BUILDS, EXPORTED, compiled
from firmware_events import CONTRACT, FRAME, POWER_ON, TIMER, Event, Senders, fuzzed, spoiled
from firmware_machines import WORDS, compiled_by_numba, in_c, interpreted
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_runs import traffic_under

from dbc.contract import PACKAGED_DBC, Contract
from dbc.frame import Frame
from dbc.node import NOTHING, Actions, next_period
from dbc.record import Record
from firmware_py import entry_points
from firmware_py import task_layout as at
from firmware_py.c_export.files import export
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.diagnosis import State
from firmware_py.node import EXECUTION_NS, Controller
from hil.scenario import load_scenario

HERE = Path(__file__).parent
CALIBRATION = chosen_tuning().calibration
STATE = 1 + 3 * at.MAX_FRAMES + at.MAILBOXES_SIZE + at.STATE


def program_of(build, directory):
    sources = [HERE / "task_driver.c", *sorted(EXPORTED.glob("*.c"))]
    return compiled(directory / build, sources, *BUILDS[build])


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """The firmware behind a pipe, in each build."""
    directory = tmp_path_factory.mktemp("c")
    return {build: program_of(build, directory) for build in BUILDS}


def assert_same(programs, modules, events):
    """All machines give the same rows; return them."""
    rows = compiled_by_numba(CALIBRATION, events)
    for program in programs.values():
        np.testing.assert_array_equal(in_c(program, events), rows)
    if modules is not None:
        np.testing.assert_array_equal(interpreted(modules, CALIBRATION, events), rows)
    return rows


def test_an_eventful_life(programs, kernel_modules):
    rows = assert_same(programs, None, list(fuzzed(seed=1, periods=20_000)))
    visits = Counter(rows[:, STATE].tolist())
    assert all(visits[state] > 100 for state in (State.STANDBY, State.RUN, State.SAFE)), visits
    assert_same({}, kernel_modules, list(fuzzed(seed=2, periods=4000)))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20, 30))
def test_a_million_eventful_periods(programs, seed):
    assert_same(programs, None, list(fuzzed(seed, periods=100_000)))


@given(data=st.data())
@settings(max_examples=40)
def test_any_sequence_of_interrupts(programs, kernel_modules, data):
    rng, senders = data.draw(st.randoms(use_true_random=False)), Senders()
    ids = [codec.can_id for codec in senders.codecs.values()] + [CONTRACT.bench_control.can_id, 0x123]
    events = [Event(POWER_ON)]
    for kind in data.draw(
        st.lists(st.sampled_from(["frame", "spoiled", "noise", "period", "on"]), max_size=80)
    ):
        name = rng.choice(sorted(senders.codecs))
        codec = senders.codecs[name]
        values = [rng.randint(field.minimum, field.minimum + field.mask) for field in codec.fields]
        frame = senders.frame(name, *values)
        noise = Frame(rng.choice(ids), rng.randint(0, 8), rng.getrandbits(64))
        heard = {"frame": [frame], "spoiled": spoiled(random.Random(rng.random()), frame), "noise": [noise]}
        events += [Event(FRAME, sent) for sent in heard.get(kind, [])]
        events += [Event(TIMER)] if kind == "period" else [Event(POWER_ON)] if kind == "on" else []
    assert_same(programs, kernel_modules, [*events, Event(TIMER)])


def test_the_documented_size_is_that_of_the_memory():
    page = EXPORTED.parents[1] / "docs" / "silicon.md"
    assert f"/* {4 * WORDS} bytes, yours to place */" in page.read_text()


# behind the node's interface, on the bench


class CFrame(ctypes.Structure):
    """`ddh_frame`."""

    _fields_ = (("can_id", ctypes.c_uint32), ("length", ctypes.c_uint8), ("data", ctypes.c_uint64))


class CController:
    """The exported C as a node."""

    name = Controller.name

    def __init__(self, library: ctypes.CDLL) -> None:
        python = Controller(CONTRACT, CALIBRATION.to_bytes())
        self.accepts, self.latched, self.transmits = python.accepts, python.latched, python.transmits
        self.record = Record(entry_points.RECORD_COLUMNS, np.int64)
        self._library = library
        self._memory = (ctypes.c_int32 * WORDS)()
        self._frames = (CFrame * at.MAX_FRAMES)()

    def on_start(self, now_ns: int) -> Actions:
        self._library.ddh_start(self._memory)
        return Actions(next_period(now_ns))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        can_id, length, data = frame
        self._library.ddh_receive(
            self._memory, ctypes.c_uint32(can_id), ctypes.c_uint8(length), ctypes.c_uint64(data)
        )
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        count = self._library.ddh_period(self._memory, self._frames)
        self.record.append((now_ns,) + (len(self.record.columns) - 1) * (0,))
        frames = [Frame(frame.can_id, frame.length, frame.data) for frame in self._frames[:count]]
        return Actions(next_period(now_ns + 1), tuple((now_ns + EXECUTION_NS, frame) for frame in frames))


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    """The committed C as a shared library."""
    directory = tmp_path_factory.mktemp("c")
    return ctypes.CDLL(
        str(compiled(directory / "ddh.so", sorted(EXPORTED.glob("*.c")), "-O2", "-shared", "-fPIC"))
    )


def test_the_same_bus_with_the_c_in_place_of_python(library):
    scenario = load_scenario("lift_lower_load")
    python = traffic_under(Controller(CONTRACT, CALIBRATION.to_bytes()), scenario)
    in_place = traffic_under(CController(library), scenario)
    assert len(python) > 3 * scenario.periods
    np.testing.assert_array_equal(in_place, python)


def test_what_was_recorded_on_the_bench_is_the_same_on_all_machines(programs, kernel_modules):
    log = Log(Controller(CONTRACT, CALIBRATION.to_bytes()))
    traffic_under(log, load_scenario("lift_lower"))
    rows = assert_same(programs, None, log.events)
    assert Counter(rows[:, STATE].tolist())[State.RUN] > 10_000
    assert_same({}, kernel_modules, log.events[:6000])


class Log:
    """A controller whose interrupts are written down."""

    def __init__(self, controller: Controller) -> None:
        self.events: list[Event] = []
        self._controller = controller
        self.name, self.accepts = controller.name, controller.accepts
        self.latched, self.transmits = controller.latched, controller.transmits

    def on_start(self, now_ns: int) -> Actions:
        self.events.append(Event(POWER_ON))
        return self._controller.on_start(now_ns)

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.events.append(Event(FRAME, frame))
        return self._controller.on_frame(now_ns, frame)

    def on_timer(self, now_ns: int) -> Actions:
        self.events.append(Event(TIMER))
        return self._controller.on_timer(now_ns)


MOVED = {
    "Controlword": (16, 32),
    "TargetVelocity": (32, 16),
    "Statusword": (16, 32),
    "ActualVelocity": (32, 16),
    "Saturations": (32, 48),
    "MailboxOverruns": (48, 32),
    "FaultReset": (20, 16),
    "Enable": (16, 20),
}
"""Start bits of signals, packaged and in another DBC file."""


def test_another_contract_is_exported_with_its_own_layout(tmp_path):
    text = PACKAGED_DBC.read_text()
    for name, (before, after) in MOVED.items():
        text, count = re.subn(rf"( SG_ {name} : ){before}\|", rf"\g<1>{after}|", text)
        assert count == 1
    (tmp_path / "other.dbc").write_text(text)
    other = Contract.load(tmp_path / "other.dbc")
    for file, source in export(chosen_tuning(), other).items():
        (tmp_path / file).write_text(source)
    program = compiled(
        tmp_path / "other", [HERE / "task_driver.c", *sorted(tmp_path.glob("*.c"))], "-O2", include=tmp_path
    )
    events = list(fuzzed(seed=2, periods=500))
    np.testing.assert_array_equal(in_c(program, events), compiled_by_numba(CALIBRATION, events, other))
