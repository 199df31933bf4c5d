"""CAN FD frames that programs send: their time on the wire, who hears them, what is left of them."""

import json
import re
import socket
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from itertools import product
from pathlib import Path

import can
import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, serving, wait_until
from bit_by_bit import reference_bits, reference_fd_bits
from can.util import CAN_FD_DLC
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.frame import BRS_FLAG, EFF_FLAG, ERR_FLAG, ESI_FLAG, FD_FLAG, Frame
from dbc.node import NOTHING, Actions
from firmware_py.diagnosis import State
from hil import cli
from hil.bench import Bench
from hil.bus import link
from hil.bus.hub import Hub, Participant
from hil.bus.messages import to_frame, to_message
from hil.bus.wire import FrameFault, Wire
from hil.bus.wire_core import MAX_PORTS
from hil.bus.wire_time import traffic_bits
from hil.bus_log import check_log_format, write_bus_log
from hil.run.inprocess import InprocessRig
from hil.run.listener import Listener
from hil.run.options import RigOptions

NOMINAL_NS, FAST_NS = 1000, 200
"""A bit at 1 and at 5 Mbit/s."""

PROGRAM = MAX_PORTS
HEADER_BITS, TAIL_BITS, FAST_BITS = 17, 12, 97
"""Of `FD`, which has no stuff bit before the switch: up to it, behind it, and between (can.md's vector)."""

FD = Frame(0x555 | FD_FLAG | BRS_FLAG, 8, 0x5555_5555_5555_5555)
CLASSIC = Frame(0x555, 8, 0x5555_5555_5555_5555)
CLASSIC_BITS = 112
LONG = Frame(0x7FF | FD_FLAG | BRS_FLAG, 64, int.from_bytes(bytes(range(64)), "little"))
ERROR_BITS, IFS_BITS = 6 + 8, 3


def fd_message(can_id: int = 0x123, data: bytes = bytes(range(12)), **kwargs) -> can.Message:
    arguments = {"is_extended_id": False, "bitrate_switch": True, **kwargs}
    return can.Message(arbitration_id=can_id, data=data, is_fd=True, check=True, **arguments)


def open_bus(**kwargs) -> can.BusABC:
    return can.Bus(interface="hilbus", channel="test", **kwargs)


def same(message: can.Message, other: can.Message) -> bool:
    return message.equals(other, timestamp_delta=None, check_direction=False, check_channel=False)


class Node:
    """A node that hears all there is for it."""

    accepts, latched, transmits = None, frozenset(), frozenset()

    def __init__(self, name: str) -> None:
        self.name = name
        self.heard: list[Frame] = []

    def on_start(self, now_ns: int) -> Actions:
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        return NOTHING

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.heard.append(frame)
        return NOTHING


@pytest.fixture
def wire():
    """A wire at 1 and 5 Mbit/s."""
    return Wire(1_000_000)


@pytest.fixture
def hub():
    with serving("test") as hub:
        yield hub


def events(wire: Wire) -> list[tuple[int, str]]:
    """Ends in ns, and what ended."""
    names = {FD.can_id: "fd", CLASSIC.can_id: "classic"}
    return [
        (time_ns, "error" if can_id & ERR_FLAG else names.get(can_id, hex(can_id)))
        for time_ns, can_id, _, _ in wire.traffic.tolist()
    ]


# on the wire


@pytest.mark.parametrize(("length", "fast_bits"), [(8, 97), (16, 161), (64, 550)])
@pytest.mark.parametrize(
    ("bit_rate", "data_bit_rate"), [(1_000_000, 5_000_000), (500_000, 2_000_000), (1_000_000, 1_000_000)]
)
def test_each_part_of_a_frame_takes_its_time_at_its_own_bit_rate(length, fast_bits, bit_rate, data_bit_rate):
    wire = Wire(bit_rate, data_bit_rate=data_bit_rate)
    frame = FD._replace(dlc=length, data=int.from_bytes(b"\x55" * length, "little"))
    wire.send(PROGRAM, 7_000, frame)
    wire.run(10**8)
    nominal_ns = (HEADER_BITS + TAIL_BITS - IFS_BITS) * 10**9 // bit_rate
    assert wire.traffic[:, 0].tolist() == [7_000 + nominal_ns + fast_bits * 10**9 // data_bit_rate]
    assert traffic_bits(wire.traffic).tolist() == [[HEADER_BITS + TAIL_BITS, fast_bits]]


def test_without_a_bit_rate_switch_all_bits_are_nominal(wire):
    wire.send(PROGRAM, 0, FD._replace(can_id=0x555 | FD_FLAG))
    wire.run(10**7)
    assert wire.traffic[0, 0] == (HEADER_BITS + FAST_BITS + TAIL_BITS - IFS_BITS) * NOMINAL_NS


@st.composite
def frames(draw):
    can_id = draw(st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EFF_FLAG)))
    fd, switched, passive = draw(st.booleans()), draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(CAN_FD_DLC[: None if fd else 9]))
    data = draw(st.binary(min_size=length, max_size=length) | st.just(bytes(length)))
    flags = FD_FLAG | BRS_FLAG * switched | ESI_FLAG * passive if fd else 0
    return Frame(can_id | flags, length, int.from_bytes(data, "little"))


def reference_length(frame: Frame) -> tuple[int, int]:
    """Bits at both rates, from the bit-by-bit reference."""
    extended = bool(frame.can_id & EFF_FLAG)
    identifier = np.array([frame.can_id & (0x1FFF_FFFF if extended else 0x7FF)], np.uint64)
    if not frame.can_id & FD_FLAG:
        return int(reference_bits(identifier, extended, frame.dlc, np.array([frame.data], np.uint64))[0]), 0
    switched, passive = bool(frame.can_id & BRS_FLAG), np.array([frame.can_id >> 33 & 1], np.uint64)
    payload = np.frombuffer(frame.data.to_bytes(frame.dlc, "little"), np.uint8).reshape(1, -1)
    nominal, fast = reference_fd_bits(identifier, extended, switched, passive, payload)
    return (int(nominal[0]), int(fast[0])) if switched else (int(nominal[0] + fast[0]), 0)


@given(
    st.lists(frames(), min_size=1, max_size=8),
    st.sampled_from([(1_000_000, 5_000_000), (125_000, 8_000_000), (333_333, 1_234_567)]),
)
@settings(deadline=None)
def test_frames_of_both_kinds_follow_each_other_to_the_nanosecond(sent, rates):
    bit_rate, data_bit_rate = rates
    wire = Wire(bit_rate, data_bit_rate=data_bit_rate)
    begin_ns, expected = 0, []
    for frame in sent:
        nominal, fast = reference_length(frame)
        fast_ns = Fraction(fast * 10**9, data_bit_rate)
        expected.append(begin_ns + int(Fraction((nominal - IFS_BITS) * 10**9, bit_rate) + fast_ns))
        wire.send(PROGRAM, begin_ns, frame)
        wire.run(10**12 if frame is sent[-1] else begin_ns + 1)
        begin_ns += int(Fraction(nominal * 10**9, bit_rate) + fast_ns)
        wire.run(begin_ns)
    assert wire.traffic[:, 0].tolist() == expected
    assert [wire.logged(row)[1] for row in range(len(sent))] == sent


def test_arbitration_does_not_ask_for_the_kind_of_frame(wire):
    order = [
        Frame(0x100, 1, 0),
        Frame(0x101 | FD_FLAG | BRS_FLAG, 64, 0),
        Frame(0x101 << 18 | EFF_FLAG, 1, 0),
        Frame(0x102, 1, 0),
        Frame(0x102 << 18 | EFF_FLAG | FD_FLAG, 12, 0),
    ]
    for sender, frame in enumerate(reversed(order)):
        wire.send(PROGRAM + sender, 0, frame)
    wire.run(10**7)
    assert [wire.logged(row)[1] for row in range(5)] == order


def test_nodes_neither_hear_nor_destroy_it(wire):
    node = Node("node")
    wire.start(wire.attach(node))
    for frame in (FD, CLASSIC, FD):
        wire.send(PROGRAM, 0, frame)
    wire.run(10**7)
    assert [what for _, what in events(wire)] == ["fd", "classic", "fd"]
    assert node.heard == [CLASSIC]


# destroyed


@pytest.mark.parametrize(
    ("bit", "header", "fast", "tail"),
    [
        (0, 1, 0, 0),
        (HEADER_BITS - 1, HEADER_BITS, 0, 0),
        (HEADER_BITS, HEADER_BITS, 1, 0),
        (HEADER_BITS + FAST_BITS - 1, HEADER_BITS, FAST_BITS, 0),
        (HEADER_BITS + FAST_BITS, HEADER_BITS, FAST_BITS, 1),
        (10_000, HEADER_BITS, FAST_BITS, TAIL_BITS - IFS_BITS),
    ],
    ids=["first bit", "switch", "first fast bit", "last fast bit", "acknowledgement", "last bit"],
)
def test_a_destroyed_frame_ends_in_an_error_frame_at_the_nominal_rate_and_is_sent_again(
    wire, bit, header, fast, tail
):
    wire.spoil(0x555, FrameFault.DESTROY, bit, 1)
    wire.send(PROGRAM, 0, FD)
    wire.run(10**7)
    error_ns = (header + tail + ERROR_BITS) * NOMINAL_NS + fast * FAST_NS
    again_ns = error_ns + IFS_BITS * NOMINAL_NS
    whole_ns = (HEADER_BITS + TAIL_BITS - IFS_BITS) * NOMINAL_NS + FAST_BITS * FAST_NS
    assert events(wire) == [(error_ns, "error"), (again_ns + whole_ns, "fd")]
    assert wire.logged(1)[1] == FD
    assert traffic_bits(wire.traffic).tolist()[0] == [header + tail + ERROR_BITS + IFS_BITS, fast]


def test_a_long_frame_without_a_switch_can_be_destroyed_near_its_end(wire):
    """More bits than a byte of the error frame's data holds."""
    wire.spoil(0x555, FrameFault.DESTROY, 500, 1)
    wire.send(PROGRAM, 0, Frame(0x555 | FD_FLAG, 64, int.from_bytes(b"\x55" * 64, "little")))
    wire.run(10**7)
    assert traffic_bits(wire.traffic).tolist()[0] == [501 + ERROR_BITS + IFS_BITS, 0]
    assert wire.traffic[0, 0] == (501 + ERROR_BITS) * NOMINAL_NS


def test_its_error_counts_as_any_other(wire):
    ports = [wire.attach(Node(name)) for name in "ab"]
    wire.spoil(0x555, FrameFault.DESTROY, 50, 32)
    wire.send(0, 0, FD)
    wire.run(10**8)
    states = [wire.error_state(port) for port in ports]
    assert len(wire.log) == 32
    assert (states[0].name, states[1].rec) == ("error-active", 32), "it was bus-off, and has recovered"
    error = to_message(*wire.logged(31))
    assert error.is_error_frame
    assert error.arbitration_id & 0x40, "CAN_ERR_BUSOFF"


def test_noise_destroys_it_as_its_length_says(wire):
    rate, count = 1e-3, 2000
    wire.disturb(rate, 10**12, seed=5)
    for number in range(count):
        wire.send(PROGRAM, number * 10**6, FD)
    wire.run(10**10)
    errors = sum(what == "error" for _, what in events(wire))
    expected = 1 - (1 - rate) ** (HEADER_BITS + FAST_BITS + TAIL_BITS - IFS_BITS)
    attempts = len(wire.log)
    assert attempts - errors == count, "none is lost"
    assert errors / attempts == pytest.approx(expected, abs=4 * (expected * (1 - expected) / attempts) ** 0.5)


def test_other_faults_leave_it_alone(wire):
    for fault, argument in ((FrameFault.DROP, 0), (FrameFault.CORRUPT, 1), (FrameFault.DELAY, 10**6)):
        wire.spoil(0x555, fault, argument, 1)
    wire.send(PROGRAM, 0, FD)
    wire.run(10**6)
    assert wire.logged(0)[1] == FD


def test_a_babbling_sender_may_send_it(wire):
    wire.babble(FD, 0, 10**6)
    wire.run(10**7)
    period_ns = (HEADER_BITS + TAIL_BITS) * NOMINAL_NS + FAST_BITS * FAST_NS
    assert np.unique(np.diff(wire.traffic[:, 0].astype(int))).tolist() == [period_ns]
    assert wire.logged(len(wire.log) - 1)[1] == FD


# programs


@pytest.mark.parametrize("length", CAN_FD_DLC)
def test_it_arrives_as_it_was_sent(hub, length):
    with open_bus(fd=True) as sender, open_bus(fd=True) as receiver:
        for extended, switched, passive in product([False, True], repeat=3):
            sent = fd_message(
                0x1FFF_FFFF if extended else 0x7FF,
                bytes(range(length)),
                is_extended_id=extended,
                bitrate_switch=switched,
                error_state_indicator=passive,
            )
            sender.send(sent)
            assert same(receiver.recv(SAFETY_NET_S), sent)


def test_it_is_filled_up_to_the_next_length_with_zeros(hub):
    with open_bus(fd=True) as sender, open_bus(fd=True) as receiver:
        sender.send(fd_message(data=b"\xff" * 9))
        heard = receiver.recv(SAFETY_NET_S)
    assert (heard.dlc, bytes(heard.data)) == (12, b"\xff" * 9 + bytes(3))


def test_time_stamps_have_both_bit_rates_in_them(hub):
    with open_bus(fd=True) as sender, open_bus(fd=True) as receiver:
        for _ in range(2):
            sender.send(to_message(0, FD))
        first, second = (receiver.recv(SAFETY_NET_S).timestamp for _ in range(2))
    period_ns = (HEADER_BITS + TAIL_BITS) * NOMINAL_NS + FAST_BITS * FAST_NS
    assert (second - first) * 1e9 >= period_ns - 1


def test_who_did_not_ask_for_it_neither_hears_nor_sends_it(hub):
    with open_bus(fd=True) as sender, open_bus() as classic:
        with pytest.raises(
            can.CanOperationError, match="open it with fd=True to send CAN FD frames"
        ) as error:
            classic.send(fd_message())
        assert "\n" not in str(error.value)
        sender.send(fd_message())
        sender.send(can.Message(arbitration_id=0x124, is_extended_id=False))
        assert classic.recv(SAFETY_NET_S).arbitration_id == 0x124
        classic.send(can.Message(arbitration_id=0x125, is_extended_id=False))
        assert sender.recv(SAFETY_NET_S).arbitration_id == 0x125
        assert (sender.protocol, classic.protocol) == (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_20)


@pytest.mark.parametrize(
    "refused",
    [
        can.Message(arbitration_id=0x800, is_extended_id=False, is_fd=True),
        can.Message(arbitration_id=1, is_fd=True, data=bytes(65)),
    ],
    ids=["12-bit id", "65 bytes"],
)
def test_what_is_no_frame_is_refused_and_does_no_harm(hub, refused):
    with open_bus(fd=True) as sender, open_bus(fd=True) as receiver:
        with pytest.raises(can.CanOperationError, match="no CAN FD frame"):
            sender.send(refused)
        sender.send(fd_message())
        assert receiver.recv(SAFETY_NET_S).is_fd


def bit_timing(bit_rate: int, data_bit_rate: int) -> can.BitTimingFd:
    return can.BitTimingFd.from_sample_point(80_000_000, bit_rate, 75.0, data_bit_rate, 75.0)


def test_bit_rates_that_are_the_hub_s_are_taken(hub):
    rates = (
        {"fd": True, "bitrate": 1_000_000, "data_bitrate": 5_000_000},
        {"timing": bit_timing(10**6, 5 * 10**6)},
    )
    for asked in rates:
        with open_bus(**asked) as bus:
            assert bus.protocol == can.CanProtocol.CAN_FD
            assert str(bus) == "hilbus channel 'test', 1000000 bit/s, CAN FD data at 5000000 bit/s"


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        ({"fd": True, "data_bitrate": 2_000_000}, "switches CAN FD data at 5000000 bit/s, not at 2000000"),
        ({"timing": bit_timing(10**6, 2 * 10**6)}, "switches CAN FD data at 5000000 bit/s, not at 2000000"),
        ({"timing": bit_timing(5 * 10**5, 5 * 10**6)}, "runs at 1000000 bit/s, not at 500000"),
    ],
    ids=["data bit rate", "data timing", "nominal timing"],
)
def test_other_bit_rates_are_refused(hub, asked, what):
    with pytest.raises(can.CanInitializationError, match=what) as error:
        open_bus(**asked)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        link.pack_frame(FD)[:-1],
        link.pack_frame(FD._replace(dlc=9)),
        link.pack_frame(FD._replace(can_id=0x800 | FD_FLAG)),
        link.pack_frame(FD)[:5] + b"\x08" + link.pack_frame(FD)[6:],
    ],
    ids=["empty", "71 bytes", "no length of CAN FD", "12-bit id", "unknown flag"],
)
def test_a_packet_that_is_no_frame_is_refused(packet):
    with pytest.raises(ValueError, match=r"no (data )?frame"):
        link.unpack_frame(packet)


def test_a_packet_has_socketcan_s_layout():
    packet = link.pack_frame(Frame(0x123 | FD_FLAG | BRS_FLAG | ESI_FLAG, 12, 0x0201))
    assert len(packet) == 72
    assert packet[:10] == b"\x23\x01\x00\x00" + bytes([12, 0x01 | 0x02 | 0x04, 0, 0]) + b"\x01\x02"


def test_payloads_that_all_have_read_are_forgotten(wire):
    for number in range(10):
        wire.send(PROGRAM, 0, FD._replace(data=number))
    wire.run(500_000)
    done = len(wire.log)
    assert 0 < done < 10
    wire.discard(done - 1)
    assert len(wire._payloads) == 10 - done + 1
    wire.run(10**7)
    assert [wire.logged(row)[1].data for row in range(len(wire.log))] == list(range(done - 1, 10))


NO_NODES: frozenset[str] = frozenset()


def test_in_virtual_time_it_is_an_injection_and_listeners_hear_it_at_its_bus_time(wire):
    with Hub(wire, "virtual", expected=NO_NODES) as hub:
        with ThreadPoolExecutor() as pool:
            opening = [pool.submit(can.Bus, interface="hilbus", channel="virtual", fd=True) for _ in range(2)]
            wait_until(lambda: hub.service(0.01) or all(bus.done() for bus in opening), "both are attached")
            sender, listener = (bus.result() for bus in opening)
        with sender, listener:
            wire.run(1_000_000)
            sender.send(to_message(0, LONG))
            wait_until(lambda: hub.service(0.01) or hub.injections, "it is taken")
            wire.run(2_000_000)
            hub.service()
            heard = listener.recv(SAFETY_NET_S)
    assert hub.injections == [(1_000_000, LONG)]
    nominal, fast = reference_length(LONG)
    end_ns = 1_000_000 + (nominal - IFS_BITS) * NOMINAL_NS + fast * FAST_NS
    assert (to_frame(heard), round(heard.timestamp * 1e9)) == (LONG, end_ns)
    assert json.loads(json.dumps(hub.injections)) == [[1_000_000, [*LONG]]]


@pytest.mark.parametrize(("fd", "dropped"), [(False, 1), (True, 3)])
def test_what_a_slow_listener_loses_is_counted_if_it_is_for_it(wire, fd, dropped):
    for frame in (FD, CLASSIC, FD):
        wire.send(PROGRAM, 0, frame)
    wire.run(10**7)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        listener = Participant(ours, "slow", PROGRAM + 1, 0, fd)
        listener.give_up(wire.log)
    assert listener.dropped == dropped


# the page about it

PAGE = Path(__file__).parents[2] / "docs" / "bus.md"


def test_the_page_s_example_runs_and_its_figures_are_right():
    page = PAGE.read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with serving("demo"), can.Bus(interface="hilbus", channel="demo", fd=True) as listener:
        exec(example, {})
        heard = listener.recv(SAFETY_NET_S)
    assert (heard.arbitration_id, heard.is_fd, heard.bitrate_switch, len(heard.data)) == (
        0x7F0,
        True,
        True,
        64,
    )
    nominal, fast = reference_length(FD._replace(dlc=64, data=int.from_bytes(b"\x55" * 64, "little")))
    assert f"64 bytes are {nominal} bits at the one and {fast} at the other" in " ".join(page.split())
    assert f"by default {Wire(1_000_000).data_bit_rate // 10**6} Mbit/s" in " ".join(page.split())


# command line


@pytest.mark.parametrize("data_bit_rate", ["999999", "8000001", "0", "-1"])
@pytest.mark.parametrize(
    "command", [["bus", "--channel", "other"], ["run", "sine", "--mode", "inprocess", "--duration", "0.1"]]
)
def test_a_data_bit_rate_that_is_none_is_refused_in_one_line(command, data_bit_rate, capsys, tmp_path):
    out = ["--out", str(tmp_path)] if command[0] == "run" else []
    assert cli.main([*command, *out, "--data-bitrate", data_bit_rate]) == cli.EXIT_USAGE
    said = capsys.readouterr().err
    assert said.startswith("hil: CAN FD data bit rate")
    assert said.count("\n") == 1


# bus logs


def kinds() -> list[can.Message]:
    """CAN FD frames of every length and kind, classic ones and an error frame between them."""
    choices = product(CAN_FD_DLC, [False, True], [False, True], [False, True])
    messages = [
        fd_message(
            0x1234_5678 if extended else 0x123,
            bytes(range(length)),
            is_extended_id=extended,
            bitrate_switch=switched,
            error_state_indicator=passive,
        )
        for length, extended, switched, passive in choices
    ]
    return [can.Message(arbitration_id=0x321, is_extended_id=False, data=b"classic"), *messages]


@pytest.fixture
def logged(wire) -> Wire:
    """A wire on which all of them have passed, one after the other."""
    for number, message in enumerate(kinds()):
        wire.send(PROGRAM, number * 10**6, to_frame(message))
    wire.spoil(0x321, FrameFault.DESTROY, 40, 1)
    wire.run(10**9)
    return wire


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4"])
def test_a_log_reads_back_frame_by_frame(logged, tmp_path, suffix):
    check_log_format(suffix)
    path = tmp_path / f"bus{suffix}"
    assert write_bus_log(path, logged.traffic, logged.payloads) == 0
    with can.LogReader(path) as reader:
        read = list(reader)
    assert [message.is_error_frame for message in read] == [True] + [False] * len(kinds())
    pairs = list(zip(read[1:], kinds(), strict=True))
    if suffix == ".asc":  # python-can reads an empty CAN FD frame in it as a remote frame
        pairs = [(message, sent) for message, sent in pairs if sent.dlc]
    assert all(same(message, sent) for message, sent in pairs)


@pytest.mark.parametrize(("suffix", "errors"), [(".trc", 1), (".csv", 0), (".db", 0)])
def test_what_a_format_has_no_room_for_is_left_out_and_counted(logged, tmp_path, suffix, errors):
    path = tmp_path / f"bus{suffix}"
    assert write_bus_log(path, logged.traffic, logged.payloads) == len(kinds()) - 1 + errors
    with can.LogReader(path) as reader:
        read = list(reader)
    assert [message.arbitration_id for message in read if not message.is_error_frame] == [0x321]


# a run


def bench_with(tmp_path: Path, *frames: Frame, data_bit_rate: int = 5_000_000) -> Bench:
    """Run for 0.2 s, with CAN FD frames every 10 ms in the second half."""
    options = RigOptions(record_directory=tmp_path, data_bit_rate=data_bit_rate)
    with InprocessRig(options) as rig:
        bench = Bench(rig, position_m=0.2)
        bench.run(0.1)
        wire = bench._session.wire
        for number, frame in enumerate(frames):
            wire.send(PROGRAM, wire.now_ns + number * 10**7, frame)
        bench.run(0.1)
        bench.end()
    return bench


def test_a_run_s_hash_has_every_byte_of_it(tmp_path):
    one, again, other = (
        bench_with(tmp_path, LONG, LONG._replace(data=LONG.data ^ last << 511)).result("x")["bus_sha256"]
        for last in (0, 0, 1)
    )
    assert one == again
    assert one != other


def test_it_shows_in_the_bus_load_and_leaves_the_loop_running(tmp_path):
    quiet, busy = bench_with(tmp_path), bench_with(tmp_path, *[LONG] * 5)
    assert busy.controller_state == State.RUN
    assert busy.timing.missed_periods.period.size == 0
    assert busy.result("x")["bus_frames"] == quiet.result("x")["bus_frames"] + 5
    load = busy.bus_load_percent(0.1).values - quiet.bus_load_percent(0.1).values
    nominal, fast = reference_length(LONG)
    seconds = 5 * (nominal / 1e6 + fast / 5e6)
    assert load[0] == pytest.approx(0.0, abs=0.1)
    assert load[1] == pytest.approx(100 * seconds / 0.1, abs=0.1), "stuff bits of others may differ"


def test_a_result_says_both_bit_rates(tmp_path):
    result = bench_with(tmp_path, data_bit_rate=2_000_000).result("x")
    assert (result["bit_rate"], result["data_bit_rate"]) == (1_000_000, 2_000_000)
    json.dumps(result)


def test_a_run_s_bus_log_has_it(tmp_path):
    bench_with(tmp_path, LONG).write(tmp_path / "out", "x")
    of_fd = [message for message in can.LogReader(tmp_path / "out" / "bus.log") if message.is_fd]
    assert [to_frame(message) for message in of_fd] == [LONG]


def test_a_real_time_bench_logs_it(hub):
    with open_bus(fd=True) as bus, open_bus(fd=True) as sender:
        listener = Listener(bus)
        with listener.listening():
            for message in kinds():
                sender.send(message)
            wait_until(lambda: len(listener.traffic(Fraction(1))) == len(kinds()), "all are heard")
    heard, payloads = listener.traffic(Fraction(1)), listener.payloads
    assert np.array_equal(traffic_bits(heard), traffic_bits(hub.wire.traffic))
    assert np.array_equal(heard[:, 1:3], hub.wire.traffic[:, 1:3])
    assert np.array_equal(payloads, hub.wire.payloads)
