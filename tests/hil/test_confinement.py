"""Errors on the wire: error frames, retransmission, counters, error-passive and bus-off (ISO 11898-1)."""

from pathlib import Path

import can
import numpy as np
import pytest
from bench_runs import serving

from dbc.frame import EFF_FLAG, ERR_FLAG, Frame
from dbc.node import NOTHING, Actions
from firmware_py.diagnosis import State
from hil.bench import Bench
from hil.bus.messages import to_message
from hil.bus.wire import FrameFault, Wire
from hil.bus.wire_time import classic_bits, traffic_bits
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions

BIT_NS = 1000
HIGH, LOW = Frame(0x100, 8, 0x0123_4567_89AB_CDEF), Frame(0x200, 2, 0xBEEF)
HIGH_BITS, LOW_BITS = classic_bits(*HIGH), classic_bits(*LOW)
IFS_BITS, ERROR_BITS = 3, 6 + 8


class Listener:
    """Hears everything and says nothing."""

    accepts, latched, transmits = None, frozenset(), frozenset()

    def __init__(self, name: str) -> None:
        self.name = name
        self.heard: list[tuple[int, Frame]] = []

    def on_start(self, now_ns: int) -> Actions:
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        return NOTHING

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.heard.append((now_ns, frame))
        return NOTHING


class Bus:
    """A wire at 1 Mbit/s with two nodes."""

    def __init__(self) -> None:
        self.wire = Wire(1_000_000)
        self.nodes = [Listener("a"), Listener("b")]
        self.ports = [self.wire.attach(node) for node in self.nodes]
        for port in self.ports:
            self.wire.start(port)

    def send(self, sender: int, frame: Frame, ready_ns: int = 0) -> None:
        self.wire.send(sender, ready_ns, frame)

    def state(self, node: int):
        return self.wire.error_state(self.ports[node])

    def counters(self) -> list[tuple[int, int]]:
        return [(state.tec, state.rec) for state in map(self.state, range(2))]

    def events(self) -> list[tuple[int, str]]:
        """Return the ends of frames in bit times, and what they were."""
        names = {HIGH.can_id: "high", LOW.can_id: "low", FIRST.can_id: "first"}
        return [
            (int(time_ns) // BIT_NS, "error" if int(can_id) & ERR_FLAG else names[int(can_id)])
            for time_ns, can_id, _, _ in self.wire.traffic
        ]


@pytest.fixture
def bus():
    return Bus()


# one error


@pytest.mark.parametrize("bit", [0, 1, 57, HIGH_BITS - IFS_BITS - 1])
def test_a_destroyed_frame_ends_in_an_error_frame_and_is_sent_again(bus, bit):
    bus.wire.spoil(HIGH.can_id, FrameFault.DESTROY, bit, 1)
    bus.send(0, HIGH)
    bus.wire.run(10**6)
    error_ends = bit + 1 + ERROR_BITS
    again = error_ends + IFS_BITS
    assert bus.events() == [(error_ends, "error"), (again + HIGH_BITS - IFS_BITS, "high")]
    assert [frame for _, frame in bus.nodes[1].heard] == [HIGH], "nobody hears the first attempt"


def test_a_frame_of_higher_priority_goes_before_the_repetition(bus):
    bus.wire.spoil(LOW.can_id, FrameFault.DESTROY, 20, 1)
    bus.send(0, LOW)
    bus.send(1, HIGH, 10 * BIT_NS)
    bus.wire.run(10**6)
    assert [what for _, what in bus.events()] == ["error", "high", "low"]


def test_the_counters_follow_the_standard(bus):
    bus.wire.spoil(HIGH.can_id, FrameFault.DESTROY, 20, 2)
    bus.send(0, HIGH)
    bus.wire.run(40 * BIT_NS)
    assert bus.counters() == [(8, 0), (0, 1)]
    bus.wire.run(80 * BIT_NS)
    assert bus.counters() == [(16, 0), (0, 2)]
    bus.wire.run(10**6)
    assert bus.counters() == [(15, 0), (0, 1)], "a frame that arrives takes one off"
    bus.send(1, LOW, bus.wire.now_ns)
    bus.wire.run(2 * 10**6)
    assert bus.counters() == [(15, 0), (0, 1)], "counters at zero stay there"


def test_an_error_frame_takes_bus_time():
    bus = Bus()
    bus.wire.spoil(HIGH.can_id, FrameFault.DESTROY, 29, 1)
    bus.send(0, HIGH)
    bus.wire.run(10**6)
    assert traffic_bits(bus.wire.traffic).tolist() == [[30 + ERROR_BITS + IFS_BITS, 0], [HIGH_BITS, 0]]


# error-passive, bus-off


def destroy(bus, attempts: int) -> int:
    """Let the first node's next attempts fail; return the end of the last error frame, ns."""
    done = len(bus.wire.log) + attempts
    bus.wire.spoil(HIGH.can_id, FrameFault.DESTROY, 0, attempts)
    bus.send(0, HIGH, bus.wire.now_ns)
    while len(bus.wire.log) < done:
        bus.wire.run(bus.wire.now_ns + BIT_NS)
    return int(bus.wire.traffic[-1, 0])


def test_sixteen_errors_make_a_transmitter_error_passive(bus):
    destroy(bus, 15)
    assert (bus.state(0).name, bus.state(0).tec) == ("error-active", 120)
    bus = Bus()
    destroy(bus, 16)
    assert (bus.state(0).name, bus.state(0).tec) == ("error-passive", 128)
    bus.wire.run(10**7)
    assert (bus.state(0).name, bus.state(0).tec) == ("error-active", 127), "the repetition arrived"


def test_an_error_passive_transmitter_lets_others_go_first(bus):
    begin = destroy(bus, 16) // BIT_NS + IFS_BITS
    bus.send(1, LOW, (begin + 5) * BIT_NS)
    bus.wire.run(10**7)
    assert [what for _, what in bus.events()[16:]] == ["low", "high"], "its suspension is eight bits"
    assert bus.events()[16][0] == begin + 5 + LOW_BITS - IFS_BITS


def test_an_error_passive_transmitter_waits_eight_bits_more_when_alone(bus):
    begin = destroy(bus, 16) // BIT_NS + IFS_BITS + 8
    bus.wire.run(10**7)
    assert bus.events()[16] == (begin + HIGH_BITS - IFS_BITS, "high")


def test_thirty_two_errors_make_a_transmitter_bus_off(bus):
    destroy(bus, 32)
    assert (bus.state(0).name, bus.state(0).tec) == ("bus-off", 256)
    assert bus.wire.waiting(0) == 0, "what it wanted to send is gone"
    assert bus.state(1).rec == 32
    bus.send(0, HIGH, bus.wire.now_ns)
    bus.send(1, LOW, bus.wire.now_ns)
    bus.wire.run(bus.wire.now_ns + 500 * BIT_NS)
    assert [what for _, what in bus.events()[32:]] == ["low"], "it does not send"
    assert bus.nodes[0].heard == [], "nor does it hear"


def test_a_receiver_becomes_error_passive_and_comes_back(bus):
    for _ in range(5):
        destroy(bus, 25)
        bus.wire.run(bus.wire.now_ns + 10**6)
        bus.wire.start(bus.ports[0])  # its own counter is not the matter here
    assert (bus.state(1).name, bus.state(1).rec) == ("error-active", 5 * 25 - 5)
    destroy(bus, 9)
    assert (bus.state(1).name, bus.state(1).rec) == ("error-passive", 129)
    bus.wire.run(bus.wire.now_ns + 10**6)
    assert (bus.state(1).name, bus.state(1).rec) == ("error-active", 127)


def test_a_bus_off_node_comes_back_after_128_times_11_recessive_bits(bus):
    idle_ns = destroy(bus, 32) + IFS_BITS * BIT_NS
    bus.wire.run(idle_ns + 128 * 11 * BIT_NS - 1)
    assert bus.state(0).name == "bus-off"
    bus.wire.run(idle_ns + 128 * 11 * BIT_NS)
    assert bus.state(0) == type(bus.state(0))("error-active", 0, 0)
    bus.send(0, HIGH, bus.wire.now_ns)
    bus.wire.run(bus.wire.now_ns + 10**6)
    assert bus.events()[-1][1] == "high"


def test_traffic_holds_the_recovery_up(bus):
    """Between two frames without a pause there is one sequence: the end of one, and its intermission."""
    begin_ns = destroy(bus, 32)
    for _ in range(127):
        bus.send(1, LOW, bus.wire.now_ns)
    bus.wire.run(begin_ns + (IFS_BITS + 127 * LOW_BITS) * BIT_NS)
    assert bus.state(0).name == "bus-off"
    bus.wire.run(bus.wire.now_ns + 11 * BIT_NS)
    assert bus.state(0).name == "error-active"


def test_power_on_clears_the_counters(bus):
    destroy(bus, 32)
    bus.wire.start(bus.ports[0])
    assert bus.state(0) == type(bus.state(0))("error-active", 0, 0)


def test_a_node_forced_bus_off_is_silent_and_deaf_for_128_times_11_recessive_bits(bus):
    bus.wire.run(5_000 * BIT_NS)  # idle bits before do not count
    bus.wire.force_bus_off(bus.ports[0])
    assert (bus.state(0).name, bus.state(0).tec, bus.state(1).name) == ("bus-off", 256, "error-active")
    bus.send(0, HIGH, bus.wire.now_ns)
    bus.wire.run((5_000 + 128 * 11) * BIT_NS - 1)
    assert bus.state(0).name == "bus-off"
    bus.wire.run((5_000 + 128 * 11) * BIT_NS)
    assert bus.state(0) == type(bus.state(0))("error-active", 0, 0)
    assert bus.events() == []
    bus.send(0, HIGH, bus.wire.now_ns)
    bus.wire.run(10**8)
    assert [what for _, what in bus.events()] == ["high"]


def test_a_node_forced_bus_off_finishes_its_frame_loses_its_queue_and_hears_nothing(bus):
    bus.send(0, HIGH)
    bus.send(0, HIGH)
    bus.send(1, LOW)
    bus.wire.run(10 * BIT_NS)
    bus.wire.force_bus_off(bus.ports[0])
    bus.wire.run((HIGH_BITS + LOW_BITS) * BIT_NS)
    assert [what for _, what in bus.events()] == ["high", "low"]
    assert bus.nodes[0].heard == []
    assert bus.state(0).name == "bus-off"


# a babbling sender

FIRST = Frame(0x000, 1, 0x55)
FIRST_BITS = classic_bits(*FIRST)


def babbling(bus) -> list[int]:
    """Return the ends of babbled frames in bit times."""
    return [int(time_ns) // BIT_NS for time_ns, can_id, _, _ in bus.wire.traffic if can_id == FIRST.can_id]


def test_a_babbling_sender_without_gaps_holds_everybody_up(bus):
    bus.wire.babble(FIRST, 0, 100 * FIRST_BITS * BIT_NS)
    bus.send(0, HIGH)
    bus.wire.run(10**8)
    assert babbling(bus) == [number * FIRST_BITS - IFS_BITS for number in range(1, 101)]
    assert int(bus.wire.traffic[-1, 0]) == (100 * FIRST_BITS + HIGH_BITS - IFS_BITS) * BIT_NS
    assert len(bus.nodes[0].heard) == len(bus.nodes[1].heard) - 1 == 100


def test_a_babbling_sender_leaves_its_gap_to_others(bus):
    bus.wire.babble(FIRST, LOW_BITS * BIT_NS, 10 * (FIRST_BITS + LOW_BITS) * BIT_NS)
    for _ in range(20):
        bus.send(0, LOW)
    bus.wire.run(9 * (FIRST_BITS + LOW_BITS) * BIT_NS)
    period = FIRST_BITS + LOW_BITS
    assert babbling(bus) == [number * period + FIRST_BITS - IFS_BITS for number in range(9)]
    assert len(bus.wire.log) == 18, "one low frame fits into each gap"


def test_a_babbling_sender_takes_part_in_arbitration(bus):
    last = Frame(0x7FF, 0, 0)
    bus.wire.babble(last, 0, 10**6)
    bus.send(0, HIGH)
    bus.send(1, LOW)
    bus.wire.run(1)
    bus.wire.run(10**7)
    heard = [int(can_id) for _, can_id, _, _ in bus.wire.traffic]
    assert heard[:3] == [HIGH.can_id, LOW.can_id, last.can_id]


def test_a_destroyed_frame_of_a_babbling_sender_is_repeated_and_it_never_goes_bus_off(bus):
    bus.wire.spoil(FIRST.can_id, FrameFault.DESTROY, 5, 40)
    bus.wire.babble(FIRST, 0, 10**6)
    bus.wire.run(10**8)
    errors = int(np.count_nonzero(bus.wire.traffic[:, 1].astype(int) & ERR_FLAG))
    assert errors == 40
    assert len(babbling(bus)) > 0
    assert bus.counters()[0][0] == 0


def test_one_sender_babbles_at_a_time(bus):
    bus.wire.babble(FIRST, 0, 1)
    bus.wire.run(10 * BIT_NS)
    with pytest.raises(ValueError, match="babbling already"):
        bus.wire.babble(LOW, 0, 1)
    bus.wire.run(FIRST_BITS * BIT_NS)
    bus.wire.babble(LOW, 0, 1)
    bus.wire.run(10**6)
    assert [what for _, what in bus.events()[1:]] == ["low"]


@pytest.mark.parametrize(("gap_ns", "duration_ns"), [(-1, 1), (0, 0), (0, -1)])
def test_babbling_that_is_none_is_refused(bus, gap_ns, duration_ns):
    with pytest.raises(ValueError, match=r"a gap is|babbling takes time"):
        bus.wire.babble(FIRST, gap_ns, duration_ns)


# noise


def noisy(seed: int, rate: float = 1e-3) -> np.ndarray:
    bus = Bus()
    bus.wire.disturb(rate, 10**12, seed)
    for number in range(3000):
        bus.send(0, HIGH, number * 500 * BIT_NS)
    bus.wire.run(10**10)
    return bus.wire.traffic


def test_noise_destroys_as_many_frames_as_its_rate_says():
    traffic = noisy(1)
    errors = np.count_nonzero(traffic[:, 1].astype(int) & ERR_FLAG)
    attempts = len(traffic)
    expected = 1 - (1 - 1e-3) ** (HIGH_BITS - IFS_BITS)
    assert errors / attempts == pytest.approx(expected, abs=4 * (expected * (1 - expected) / attempts) ** 0.5)
    assert attempts - errors == 3000, "none is lost"


def test_the_same_seed_is_the_same_noise():
    assert np.array_equal(noisy(3), noisy(3))
    assert not np.array_equal(noisy(3), noisy(4))


def test_noise_ends():
    bus = Bus()
    bus.wire.disturb(0.5, 1)
    bus.wire.run(2)
    bus.send(0, HIGH, 2)
    bus.wire.run(10**6)
    assert [what for _, what in bus.events()] == ["high"]


@pytest.mark.parametrize("rate", [0.0, 0.6, -1.0, float("nan")])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(ValueError, match=r"a bit error rate is from 1e-9 to 0.5"):
        Bus().wire.disturb(rate, 1)


# what others see


def test_an_error_frame_is_one_for_python_can(bus):
    destroy(bus, 32)
    time_ns, can_id, dlc, data = bus.wire.traffic[-1].tolist()
    message = to_message(time_ns, Frame(can_id, dlc, data))
    assert message.is_error_frame
    assert not message.is_extended_id
    linux = message.arbitration_id
    assert linux & 0x08, "CAN_ERR_PROT"
    assert linux & 0x40, "CAN_ERR_BUSOFF"
    assert linux & 0x200, "CAN_ERR_CNT"
    assert message.data[2] == 0x01, "CAN_ERR_PROT_BIT"
    assert (message.data[6], message.data[7]) == (255, 0)
    assert linux & EFF_FLAG == 0


def test_a_program_on_the_embedded_bus_hears_error_frames():
    with serving("errors") as hub:
        hub.wire.spoil(HIGH.can_id, FrameFault.DESTROY, 9, 1)
        with (
            can.Bus(interface="hilbus", channel="errors") as listener,
            can.Bus(interface="hilbus", channel="errors") as sender,
        ):
            sender.send(to_message(0, HIGH))
            heard = [listener.recv(30.0) for _ in range(2)]
    assert [message.is_error_frame for message in heard] == [True, False]
    between_ns = (heard[1].timestamp - heard[0].timestamp) * 1e9
    assert between_ns == pytest.approx((IFS_BITS + HIGH_BITS - IFS_BITS) * BIT_NS, abs=1.0)


def test_a_log_keeps_error_frames(tmp_path, bus):
    from hil.bus_log import write_bus_log

    destroy(bus, 1)
    bus.wire.run(10**6)
    write_bus_log(Path(tmp_path / "bus.log"), bus.wire.traffic)
    read = list(can.LogReader(tmp_path / "bus.log"))
    assert [message.is_error_frame for message in read] == [True, False]


# the closed loop


@pytest.fixture
def bench(tmp_path):
    with InprocessRig(RigOptions(record_directory=tmp_path)) as rig:
        bench = Bench(rig, controller="adrc", position_m=0.2)
        bench.setpoint(lambda t: 0.2 + 0.05 * np.sin(2 * np.pi * 0.5 * t))
        bench.run(0.5)
        yield bench


def test_a_few_destroyed_commands_are_repeated_within_their_period(bench):
    bench.destroy("DriveCommand", count=2)
    bench.run(0.5)
    assert bench.controller_state == State.RUN
    assert bench.timing.missed_periods.period.size == 0
    assert bench.error_state("controller").name == "error-active"


def test_bus_load_by_window_shows_where_attempts_were_destroyed(bench):
    bench.destroy("DriveCommand", bit=60, count=5)
    bench.run(0.1)
    load = bench.bus_load_percent(window_s=0.01)
    assert len(load) == 60
    struck = int(np.argmax(load.values))
    assert load.time_s[struck] == pytest.approx(0.51)
    same_messages = load.values[struck - 10]  # 100 ms before
    more_bits = (load.values[struck] - same_messages) / 100 * 10_000
    assert more_bits == pytest.approx(5 * (61 + ERROR_BITS + IFS_BITS), abs=25), "stuff bits differ"


@pytest.mark.parametrize("window_s", [0.0, -1.0, float("nan")])
def test_a_window_has_a_length(bench, window_s):
    with pytest.raises(ValueError, match="a window is longer than nothing"):
        bench.bus_load_percent(window_s)


def test_a_controller_that_goes_bus_off_is_stopped_by_the_drive_and_recovers_when_reset(bench):
    bench.destroy("DriveCommand", count=32)
    bench.run(0.003)
    assert bench.error_state("controller").name == "bus-off"
    bench.run(0.1)
    assert bench.controller_state == State.SAFE
    assert abs(bench.motor_speed_rpm.last) < 1.0
    assert bench.error_state("controller").name == "error-active", "it came back by itself"
    bench.recover()
    bench.run(0.1)
    bench.enable()
    bench.run(0.2)
    assert bench.controller_state == State.RUN
