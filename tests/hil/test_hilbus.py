"""The embedded bus as a python-can interface, and the hub that serves it."""

import os
import select
import socket
import stat
from collections.abc import Iterator
from itertools import pairwise, product

import can
import pytest
from bench_runs import SAFETY_NET_S, hil, serving

from dbc.frame import EFF_FLAG, Frame
from hil.bus import link
from hil.bus.hub import Hub
from hil.bus.link import LinkError
from hil.bus.wire import Wire
from hil.bus.wire_core import INTERMISSION_BITS, MAX_PORTS
from hil.bus.wire_time import frame_bits


def message(can_id: int = 0x123, data: bytes = b"\x01\x02\x03", extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def open_bus(**kwargs) -> can.BusABC:
    return can.Bus(interface="hilbus", channel="test", **kwargs)


# python-can's contract


def test_a_frame_travels_from_one_program_to_all_others_but_not_back(hub):
    with open_bus() as sender, open_bus() as one, open_bus() as other:
        sender.send(message())
        for receiver in (one, other):
            received = receiver.recv(SAFETY_NET_S)
            assert (received.arbitration_id, bytes(received.data)) == (0x123, b"\x01\x02\x03")
            assert not received.is_extended_id
            assert received.is_rx
            assert received.channel == "test"
        other.send(message(0x124))  # what comes first is not our own frame
        assert sender.recv(SAFETY_NET_S).arbitration_id == 0x124


def test_identifiers_and_data_arrive_as_sent(hub):
    ids = [(0, False), (0x7FF, False), (0, True), (0x7FF, True), (0x1FFF_FFFF, True)]
    payloads = [b"", b"\x00", b"\xff" * 8, b"\x00\x11\x22\x33\x44\x55\x66\x77"]
    with open_bus() as sender, open_bus() as receiver:
        for (can_id, extended), data in product(ids, payloads):
            sent = message(can_id, data, extended)
            sender.send(sent)
            received = receiver.recv(SAFETY_NET_S)
            assert received.equals(sent, timestamp_delta=None, check_direction=False, check_channel=False)


def test_many_frames_of_one_sender_keep_their_order_and_none_is_lost(hub):
    with open_bus() as sender, open_bus() as receiver:
        for number in range(2000):
            sender.send(message(0x100, number.to_bytes(2, "big")))
        received = [receiver.recv(SAFETY_NET_S) for _ in range(2000)]
    assert [int.from_bytes(m.data, "big") for m in received] == list(range(2000))
    assert hub.dropped == 0


def test_timestamps_are_bus_time_and_a_burst_takes_its_time_on_the_wire(hub):
    with open_bus() as sender, open_bus() as receiver:
        for _ in range(10):
            sender.send(message())
        stamps_s = [receiver.recv(SAFETY_NET_S).timestamp for _ in range(10)]
    assert 0.0 < stamps_s[0] < SAFETY_NET_S
    shortest_s = frame_bits(message()) * 1e-6
    assert all(later - earlier >= shortest_s - 1e-9 for earlier, later in pairwise(stamps_s))


def test_filters_keep_other_frames_out(hub):
    only = [{"can_id": 0x100, "can_mask": 0x7FF, "extended": False}]
    with open_bus() as sender, open_bus(can_filters=only) as receiver:
        for can_id, extended in ((0x101, False), (0x100, True), (0x100, False)):
            sender.send(message(can_id, extended=extended))
        received = receiver.recv(SAFETY_NET_S)
        assert (received.arbitration_id, received.is_extended_id) == (0x100, False)
        receiver.set_filters(None)
        sender.send(message(0x101))
        assert receiver.recv(SAFETY_NET_S).arbitration_id == 0x101


def test_receiving_with_a_timeout_returns_nothing_from_a_silent_bus(hub):
    with open_bus() as bus:
        assert bus.recv(0.0) is None
        assert bus.recv(0.01) is None


def test_what_busabc_offers_on_top(hub):
    with open_bus() as sender, open_bus() as receiver:
        assert sender.protocol == can.CanProtocol.CAN_20
        assert sender.state == can.BusState.ACTIVE
        assert "test" in str(sender)
        assert "1000000" in sender.channel_info
        reader = can.BufferedReader()
        notifier = can.Notifier(receiver, [reader], timeout=0.01)
        task = sender.send_periodic(message(), period=0.005)
        received = [reader.get_message(SAFETY_NET_S) for _ in range(3)]
        task.stop()
        notifier.stop()
        assert {m.arbitration_id for m in received} == {0x123}


def test_a_readable_descriptor_says_that_a_frame_is_there(hub):
    with open_bus() as sender, open_bus() as receiver:
        assert select.select([receiver], [], [], 0.0) == ([], [], [])
        sender.send(message())
        assert select.select([receiver], [], [], SAFETY_NET_S)[0] == [receiver]
        assert receiver.recv(0.0) is not None


def test_options_that_tools_pass_are_taken(hub):
    open_bus(single_handle=True, bitrate=1_000_000, receive_own_messages=False).shutdown()


def test_shutdown_may_be_called_twice(hub):
    bus = open_bus()
    bus.shutdown()
    bus.shutdown()


# what it refuses


@pytest.mark.parametrize(
    "refused",
    [
        can.Message(arbitration_id=1, is_fd=True, data=b"\x00" * 12),
        can.Message(arbitration_id=1, is_remote_frame=True),
        can.Message(is_error_frame=True),
    ],
    ids=["FD", "remote", "error"],
)
def test_other_frames_than_classic_data_frames_are_refused_and_do_no_harm(hub, refused):
    with open_bus() as sender, open_bus() as receiver:
        with pytest.raises(can.CanOperationError, match="only classic data frames"):
            sender.send(refused)
        sender.send(message())
        assert receiver.recv(SAFETY_NET_S).arbitration_id == 0x123


def test_without_a_hub_one_line_says_how_to_start_one():
    with pytest.raises(can.CanInitializationError) as error:
        can.Bus(interface="hilbus", channel="nowhere")
    assert "hil bus --channel nowhere" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("channel", ["", "a/b", "..", ".hidden", "two words", "x" * 120])
def test_a_channel_name_that_cannot_be_a_socket_is_refused(channel):
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="hilbus", channel=channel)


def test_a_hub_that_ends_is_noticed_by_sender_and_receiver():
    with serving("test"):
        bus = open_bus()
    with bus:
        with pytest.raises(can.CanOperationError, match="ended"):
            bus.recv(SAFETY_NET_S)
        with pytest.raises(can.CanOperationError, match="hilbus channel 'test'"):
            bus.send(message())


def test_a_bus_that_was_shut_down_neither_sends_nor_receives(hub):
    bus = open_bus()
    bus.shutdown()
    with pytest.raises(can.CanOperationError):
        bus.send(message())
    with pytest.raises(can.CanOperationError):
        bus.recv(0.01)


# finding hubs


def test_running_hubs_are_detected_and_dead_sockets_are_not(hub, socket_directory):
    directory = link.socket_directory()
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dead.bind(os.fspath(directory / "dead.sock"))
    dead.close()
    assert can.detect_available_configs("hilbus") == [{"interface": "hilbus", "channel": "test"}]
    with open_bus():
        pass  # the probe did not upset the hub


def test_without_any_hub_nothing_is_detected():
    assert can.detect_available_configs("hilbus") == []


# the socket


def test_the_socket_lies_in_a_private_directory(hub, socket_directory):
    directory = link.socket_directory()
    assert directory.parent == socket_directory
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    assert stat.S_ISSOCK((directory / "test.sock").stat().st_mode)


def test_a_directory_that_others_can_enter_is_refused(socket_directory):
    link.socket_directory().chmod(0o755)
    with pytest.raises(LinkError, match="not a private directory"):
        link.socket_directory()


def test_a_directory_that_is_a_link_is_refused(socket_directory):
    elsewhere = socket_directory / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    (socket_directory / f"hilbus-{os.getuid()}").symlink_to(elsewhere)
    with pytest.raises(LinkError, match="not a private directory"):
        link.socket_directory()


def test_a_hub_removes_its_socket_and_may_be_closed_twice():
    hub = Hub(Wire(1_000_000), "test", expected=None)
    path = link.socket_path("test")
    assert path.exists()
    hub.close()
    hub.close()
    assert not path.exists()


def test_the_socket_of_a_dead_hub_is_taken_over():
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    stale.bind(os.fspath(link.socket_path("test")))
    stale.close()
    with Hub(Wire(1_000_000), "test", expected=None) as hub:
        hub.service()
        assert link.socket_path("test").exists()


def test_a_second_hub_on_a_channel_is_refused_and_the_first_goes_on(hub):
    with pytest.raises(LinkError, match="has a hub already"):
        Hub(Wire(1_000_000), "test", expected=None)
    with open_bus() as sender, open_bus() as receiver:
        sender.send(message())
        assert receiver.recv(SAFETY_NET_S) is not None
    ended = hil("bus", "--channel", "test")
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert "choose another --channel" in ended.stderr


@pytest.mark.parametrize(
    "greeting",
    [
        b"",
        b"\x00" * 16,
        b"[]",
        b"{}",
        b'{"version": 99, "role": "bus"}',
        b'{"version": 1}',
        b'{"version": 1, "role": "node"}',
        b'{"version": 1, "role": "bus", "name": ["x"]}',
        b'{"version": 1, "role": "node", "name": "n", "accepts": 5, "latched": null, "transmits": []}',
    ],
)
@pytest.mark.parametrize("expected", [None, frozenset({"plant"})])
def test_a_stranger_that_talks_nonsense_does_not_stop_the_hub(greeting, expected):
    with Hub(Wire(1_000_000), "test", expected=expected) as hub:
        stranger = link.seqpacket_socket()
        stranger.connect(os.fspath(link.socket_path("test")))
        stranger.send(greeting)
        for _ in range(3):
            hub.service()
        stranger.close()
        for _ in range(3):
            hub.service()
        assert hub.nodes == {} or b"node" in greeting


def test_a_slow_listener_loses_frames_that_are_counted_and_holds_up_nobody(monkeypatch):
    monkeypatch.setattr("hil.bus.hub.QUEUE_FRAMES", 100)
    wire = Wire(1_000_000, out_of_band=frozenset({1}))
    with Hub(wire, "test", expected=frozenset({"plant", "controller"})) as hub:
        ours = link.seqpacket_socket()
        ours.connect(os.fspath(link.socket_path("test")))
        link.send_json(ours, {"version": link.PROTOCOL_VERSION, "role": "bus"})
        for _ in range(3):
            hub.service()
        assert link.receive_json(ours)["virtual"] is True
        ours.setblocking(False)
        for number in range(10_000):
            wire.send(MAX_PORTS + 9, wire.now_ns, Frame(1, 2, number))
            wire.run(wire.now_ns + 1)
            if number % 1000 == 0:
                hub.service()
        assert len(wire.traffic) == 10_000
        received = []
        while True:
            hub.service()
            try:
                received.append(link.unpack_timed(ours.recv(link.MAX_PACKET))[1].data)
            except BlockingIOError:
                break
        assert hub.dropped > 0
        assert received == sorted(set(received))
        assert len(received) == 10_000 - hub.dropped
        ours.close()


# packets


def test_frames_lie_in_packets_as_in_socketcan():
    frame = Frame(0x1234 | EFF_FLAG, 3, 0x030201)
    assert link.pack_frame(frame) == bytes.fromhex("34120080 03 000000 0102030000000000")
    assert link.unpack_frame(link.pack_frame(frame)) == frame
    assert link.unpack_timed(link.pack_timed(-5, frame)) == (-5, frame)


def test_bus_time_in_wall_time_follows_the_clock_and_never_runs_ahead():
    """One frame per turn of the loop: each starts when it was sent, the last one never ends."""
    turns_ns = (0, 50_000_000, 51_000_000)
    clock_ns = origin_ns = 7_000_000_000
    frame = Frame(0x123, 3, 0x030201)
    with (
        Hub(Wire(1_000_000), "test", expected=None) as hub,
        link.seqpacket_socket() as sender,
        link.seqpacket_socket() as receiver,
    ):
        for end in (sender, receiver):
            end.connect(os.fspath(link.socket_path("test")))
            link.send_json(end, {"version": link.PROTOCOL_VERSION, "role": "bus"})
            for _ in range(3):
                hub.service()
            assert link.receive_json(end)["virtual"] is False

        def turns() -> Iterator[bool]:
            nonlocal clock_ns
            for turn_ns in turns_ns:
                clock_ns = origin_ns + turn_ns
                sender.send(link.pack_frame(frame))
                yield True
            yield False

        hub.run_in_wall_time(turns().__next__, lambda: clock_ns)
        receiver.setblocking(False)
        ends_ns = [link.unpack_timed(receiver.recv(link.MAX_PACKET))[0] for _ in range(2)]
        with pytest.raises(BlockingIOError):
            receiver.recv(link.MAX_PACKET)
    duration_ns = (frame_bits(message()) - INTERMISSION_BITS) * 1000
    assert ends_ns == [turn_ns + duration_ns for turn_ns in turns_ns[:2]]
