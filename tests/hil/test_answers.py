"""A node that answers events itself, for speed, does exactly what its entry points do."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_runs import sha256, short_scenario
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand, BenchFault
from dbc.node import PERIOD_NS, Node
from dbc.packet import FRAME, START, TIMER, answer_by_entry_points, append_frame, pack_event, unpack_actions
from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.node import Controller
from firmware_py.tuning import TUNINGS
from hil.bus.link import MAX_PACKET
from hil.references import lift_lower, sine
from hil.run.inprocess import run_inprocess
from hil.run.options import RunOptions
from hil.supervisor import Supervisor
from plant_sim.node import Plant
from plant_sim.parameters import NOMINAL
from plant_sim.sensors import PositionSensor

CONTRACT = Contract.load()
BLOCK = TUNINGS["robust"].calibration().to_bytes()


def controller() -> Controller:
    return Controller(CONTRACT, BLOCK)


def plant() -> Plant:
    return Plant(CONTRACT, NOMINAL)


def plant_with_noise() -> Plant:
    return Plant(CONTRACT, NOMINAL, PositionSensor(noise_rms_m=1e-5))


def packet_of(kind: int, now_ns: int, frames: list[tuple[int, Frame]]) -> bytes:
    packet = bytearray(MAX_PACKET)
    head = pack_event(kind, now_ns)
    packet[: len(head)] = head
    length = len(head)
    for time_ns, frame in frames:
        length = append_frame(packet, length, time_ns, frame)
    return bytes(packet[:length])


def heard_by(node: Node) -> st.SearchStrategy[Frame]:
    """Frames of what a node accepts: noise, what a sender would say, and what the bench says."""
    ids = sorted(node.accepts or ())
    payload = st.integers(0, 2**64 - 1)
    noise = st.builds(Frame, st.sampled_from(ids), st.integers(0, 8), payload)
    messages = [message for message in CONTRACT.messages if message.can_id in ids]
    intact = []
    for message in messages:
        if message.data_ids is not None:
            protect = message.protector().protect
            intact.append(payload.map(lambda data, m=message, p=protect: m.frame(p(data % 256**m.dlc))))
    bench = CONTRACT.bench_control
    reset = st.integers(-(2**31), 2**31 - 1).map(
        lambda at: bench.frame(bench.pack(BenchCommand.RESET, 0, at))
    )
    return st.one_of(noise, *intact, *intact, *intact, reset)


EVENTS = st.tuples(st.sampled_from([TIMER] * 4 + [FRAME] * 2 + [START]), st.integers(0, 3 * PERIOD_NS))


def assert_same_answers(node: Any, twin: Any, packets: Iterable[bytes]) -> None:
    """Ask a node itself and the entry points of its twin."""
    ours, theirs = bytearray(MAX_PACKET), bytearray(MAX_PACKET)
    for packet in map(memoryview, packets):
        length = node.answer(packet, ours)
        assert length == answer_by_entry_points(twin, packet, theirs)
        assert ours[:length] == theirs[:length]
    ours_by_name, theirs_by_name = node.record.columns_by_name(), twin.record.columns_by_name()
    assert all(np.array_equal(ours_by_name[name], theirs_by_name[name]) for name in theirs_by_name)


@pytest.mark.parametrize("new_node", [controller, plant, plant_with_noise])
@settings(max_examples=60)
@given(data=st.data())
def test_any_events_are_answered_as_by_the_entry_points(new_node: Callable[[], Any], data):
    node, now_ns = new_node(), 0
    frames = heard_by(node)
    packets = [pack_event(START)]
    for kind, later_ns in data.draw(st.lists(EVENTS, max_size=30)):
        now_ns += later_ns
        heard = [] if kind == START else data.draw(st.lists(st.tuples(st.just(now_ns), frames), max_size=4))
        packets.append(packet_of(kind, now_ns, heard))
    assert_same_answers(node, new_node(), packets)


@pytest.mark.parametrize("message", [CONTRACT.drive_command, CONTRACT.bench_load])
def test_a_frame_that_came_by_itself_counts_with_the_next_timer(message):
    protect = message.protector().protect if message.data_ids else int
    first, second = (message.frame(protect(message.pack(*(6 for _ in message.fields)))) for _ in range(2))
    events = [(TIMER, [(0, first)]), (FRAME, [(0, second)]), (TIMER, []), (TIMER, [])]
    packets = (packet_of(kind, number * PERIOD_NS, heard) for number, (kind, heard) in enumerate(events))
    assert_same_answers(plant(), plant(), packets)


@pytest.mark.parametrize("fault", BenchFault)
def test_a_faulty_sensor_is_answered_for_as_by_the_entry_points(fault):
    bench = CONTRACT.bench_control
    on, off = (bench.frame(bench.pack(BenchCommand.SET_FAULT, fault, value)) for value in (1000, 0))
    heard = {5: [(0, on)], 30: [(0, off)]}
    packets = (packet_of(TIMER, period * PERIOD_NS, heard.get(period, [])) for period in range(50))
    assert_same_answers(plant(), plant(), packets)


PERIODS_AHEAD = st.integers(-2, 150)
STEERING = st.one_of(
    st.fixed_dictionaries({"enable": st.integers(0, 1)}),
    st.fixed_dictionaries({"load_n": st.integers(-3000, 3000)}),
    st.fixed_dictionaries({"add_load_n": st.integers(-3000, 3000)}),
    st.fixed_dictionaries({"reference": st.sampled_from([sine, lift_lower, lambda time_s: 0.1])}),
)
SILENT = st.sampled_from([set(), {CONTRACT.position_setpoint.can_id}, {CONTRACT.controller_command.can_id}])


@settings(max_examples=30)
@given(
    acts=st.lists(
        st.tuples(
            st.lists(st.tuples(PERIODS_AHEAD, STEERING), max_size=2),
            SILENT,
            st.integers(0, 120),
            st.sampled_from([0, 0, 0, 1, PERIOD_NS // 2, 3 * PERIOD_NS]),
        ),
        max_size=12,
    )
)
def test_the_supervisor_too_however_it_is_steered_and_however_late_it_is_asked(acts):
    node, twin = Supervisor(CONTRACT, "adrc", 0.1), Supervisor(CONTRACT, "adrc", 0.1)
    ours, theirs = bytearray(MAX_PACKET), bytearray(MAX_PACKET)

    def ask(kind: int, now_ns: int) -> int:
        packet = memoryview(pack_event(kind, now_ns))
        length = node.answer(packet, ours)
        assert length == answer_by_entry_points(twin, packet, theirs)
        assert ours[:length] == theirs[:length]
        return unpack_actions(ours, length).wake_ns

    wake_ns = ask(START, 0)
    for plans, silent, periods, late_ns in acts:
        for ahead, words in plans:
            for each in (node, twin):
                each.plan(each.next_period + ahead, **words)
        node.silent, twin.silent = set(silent), set(silent)
        for _ in range(periods):
            wake_ns = ask(TIMER, wake_ns)
        wake_ns = ask(TIMER, wake_ns + late_ns)
    assert node.next_period == twin.next_period
    ours_by_name, theirs_by_name = node.record.columns_by_name(), twin.record.columns_by_name()
    assert all(np.array_equal(ours_by_name[name], theirs_by_name[name]) for name in theirs_by_name)


# hil.bus.wire asks through it
ASKED_THROUGH = "hil.bus.wire.answers_of"


@pytest.mark.parametrize("tuning", ["paper", "robust"])
def test_a_run_is_the_same_as_by_the_entry_points(monkeypatch, tuning):
    scenario = short_scenario(1.0, load=((0.4, -2000.0), (0.7, 500.0)))
    options = RunOptions(scenario, record_directory=Path(), tuning=chosen_tuning(tuning))
    by_answers = run_inprocess(options)
    monkeypatch.setattr(ASKED_THROUGH, lambda node: partial(answer_by_entry_points, node))
    by_entry_points = run_inprocess(options)
    assert sha256(by_answers) == sha256(by_entry_points)
    for side in ("supervisor", "plant", "controller"):
        ours, theirs = getattr(by_answers, side), getattr(by_entry_points, side)
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)


def test_the_record_of_a_node_goes_on_where_its_room_ends():
    node, twin = controller(), controller()
    answer = bytearray(MAX_PACKET)
    for each in (node, twin):
        each.on_start(0)
    for period in range(2 * len(node.record.rows) + 1):
        node.answer(memoryview(pack_event(TIMER, period * PERIOD_NS)), answer)
        twin.on_timer(period * PERIOD_NS)
    ours, theirs = node.record.columns_by_name(), twin.record.columns_by_name()
    assert ours["time_ns"].tolist() == [period * PERIOD_NS for period in range(period + 1)]
    assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
