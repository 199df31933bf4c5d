"""The embedded bus as a python-can interface, and the hub that serves it."""

import asyncio
import os
import select
import socket
import stat
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice, pairwise, product, takewhile
from threading import Thread

import can
import pytest
from bench_runs import SAFETY_NET_S, background, hil, serving, wait_until

from dbc.frame import EFF_FLAG, Frame
from hil.bus import link
from hil.bus.hub import Hub
from hil.bus.link import LinkError
from hil.bus.wire import Wire
from hil.bus.wire_core import MAX_PORTS
from hil.bus.wire_time import INTERMISSION_BITS, frame_bits


def message(can_id: int = 0x123, data: bytes = b"\x01\x02\x03", extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def open_bus(**kwargs) -> can.BusABC:
    return can.Bus(interface="hilbus", channel="test", **kwargs)


def numbers(messages: list[can.Message]) -> list[int]:
    return [int.from_bytes(m.data, "big") for m in messages]


def hear(bus: can.BusABC, count: int) -> list[can.Message]:
    heard = list(takewhile(bool, (bus.recv(SAFETY_NET_S) for _ in range(count))))
    assert len(heard) == count, f"{count - len(heard)} frames never came"
    return heard


def send_for_ever(bus: can.BusABC, timeout: float | None = None) -> None:
    while True:
        bus.send(message(), timeout)


@contextmanager
def stalled_hub() -> Iterator[tuple[can.BusABC, socket.socket]]:
    """A bus whose hub does nothing by itself, and the hub's end of its link."""
    accepted = []

    def greet() -> None:
        connection, _ = listener.accept()
        link.receive_json(connection)
        rates = {"bit_rate": 1_000_000, "data_bit_rate": 5_000_000}
        link.send_json(connection, {"virtual": False, **rates})
        accepted.append(connection)

    with link.seqpacket_socket() as listener:
        listener.bind(os.fspath(link.socket_path("test")))
        listener.listen()
        greeter = Thread(target=greet)
        greeter.start()
        with open_bus() as bus:
            greeter.join()
            with accepted[0]:
                yield bus, accepted[0]


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
        assert numbers(hear(receiver, 2000)) == list(range(2000))
    assert hub.dropped == 0


def test_timestamps_are_the_bus_clock_s_and_a_burst_takes_its_time_on_the_wire(hub):
    with open_bus() as sender, open_bus() as one, open_bus() as other:
        for _ in range(10):
            sender.send(message())
        stamps_s = [m.timestamp for m in hear(one, 10)]
        assert [m.timestamp for m in hear(other, 10)] == stamps_s
    assert [round(stamp_s * 1e9) for stamp_s in stamps_s] == hub.wire.traffic[:, 0].tolist()
    shortest_s = frame_bits(message()) * 1e-6
    assert all(later - earlier >= shortest_s - 1e-9 for earlier, later in pairwise(stamps_s))


OFFERED = [
    (0x100, True),
    (0x100, False),
    (0x101, False),
    (0x200, False),
    (0x18FE_0001, True),
    (0x18FF_0001, True),
    (0x18FF_00FF, True),
]
"""In the order in which they win arbitration: the bus need not keep another one between different ids."""


@pytest.mark.parametrize(
    ("filters", "passed"),
    [
        (None, OFFERED),
        ([], OFFERED),
        ([{"can_id": 0x100, "can_mask": 0x7FF, "extended": False}], [(0x100, False)]),
        ([{"can_id": 0x100, "can_mask": 0x1FFF_FFFF, "extended": True}], [(0x100, True)]),
        ([{"can_id": 0x100, "can_mask": 0x7F0}], [(0x100, True), (0x100, False), (0x101, False)]),
        (
            [{"can_id": 0x18FF_1234, "can_mask": 0x1FFF_0000, "extended": True}],
            [(0x18FF_0001, True), (0x18FF_00FF, True)],
        ),
        (
            [
                {"can_id": 0x200, "can_mask": 0x7FF, "extended": False},
                {"can_id": 0x18FE_0001, "can_mask": 0x1FFF_FFFF, "extended": True},
            ],
            [(0x200, False), (0x18FE_0001, True)],
        ),
    ],
    ids=["none", "empty", "standard", "extended", "both", "mask", "several"],
)
def test_filters_let_through_what_they_name(hub, filters, passed):
    with open_bus() as sender, open_bus(can_filters=filters) as at_once, open_bus() as later:
        later.set_filters(filters)
        for can_id, extended in OFFERED:
            sender.send(message(can_id, extended=extended))
        for receiver in (at_once, later):
            heard = hear(receiver, len(passed))
            assert [(m.arbitration_id, m.is_extended_id) for m in heard] == passed


def test_filters_may_be_changed_and_taken_away(hub):
    def only(*ids: int) -> list[dict[str, int]]:
        return [{"can_id": can_id, "can_mask": 0x7FF} for can_id in ids]

    last = 0x1FF
    rounds = (
        (only(0x101, last), [0x101, last]),
        (only(0x102, last), [0x102, last]),
        (None, [0x101, 0x102, last]),
    )
    with open_bus() as sender, open_bus() as receiver:
        for filters, heard in rounds:
            receiver.set_filters(filters)
            for can_id in (0x101, 0x102, last):
                sender.send(message(can_id))
            assert [m.arbitration_id for m in hear(receiver, len(heard))] == heard


def test_receiving_with_a_timeout_returns_nothing_from_a_silent_bus(hub):
    with open_bus() as bus:
        assert bus.recv(0.0) is None
        assert bus.recv(0.01) is None


def test_iterating_over_a_bus_yields_its_frames_until_it_is_shut_down(hub):
    with open_bus() as sender, open_bus() as receiver:
        for number in range(3):
            sender.send(message(data=bytes([number])))
        assert numbers(list(islice(receiver, 3))) == [0, 1, 2]
        receiver.shutdown()
        with pytest.raises(can.CanOperationError, match="shut down"):
            next(iter(receiver))


def test_what_a_bus_says_of_itself(hub):
    with open_bus() as bus:
        assert bus.protocol == can.CanProtocol.CAN_20
        assert bus.state == can.BusState.ACTIVE
        assert str(bus) == bus.channel_info == "hilbus channel 'test', 1000000 bit/s"
        assert bus.filters is None


def test_what_python_can_leaves_open_is_left_open_as_on_socketcan(hub):
    with open_bus() as bus:
        with pytest.raises(NotImplementedError):
            bus.flush_tx_buffer()
        with pytest.raises(NotImplementedError):
            bus.state = can.BusState.PASSIVE


@pytest.mark.parametrize("bus_class", [can.Bus, can.ThreadSafeBus])
def test_threads_share_a_bus_and_no_frame_is_lost_torn_or_overtaken(hub, bus_class):
    """Four threads send and two receive at either end, all at once."""
    ids = {"ours": range(0x100, 0x104), "theirs": range(0x200, 0x204)}
    count = 200
    heard: dict[str, list[can.Message]] = {end: [] for end in ids}

    def send(bus: can.BusABC, can_id: int) -> None:
        for number in range(count):
            bus.send(message(can_id, 2 * (can_id.to_bytes(2, "big") + number.to_bytes(2, "big"))))

    def receive(bus: can.BusABC, into: list[can.Message]) -> None:
        until_s = time.monotonic() + SAFETY_NET_S
        while len(into) < 4 * count and time.monotonic() < until_s:
            if received := bus.recv(0.01):
                into.append(received)

    with (
        bus_class(interface="hilbus", channel="test") as ours,
        bus_class(interface="hilbus", channel="test") as theirs,
        ThreadPoolExecutor(12) as pool,
    ):
        work = [pool.submit(receive, ours, heard["theirs"]) for _ in range(2)]
        work += [pool.submit(receive, theirs, heard["ours"]) for _ in range(2)]
        work += [pool.submit(send, ours, can_id) for can_id in ids["ours"]]
        work += [pool.submit(send, theirs, can_id) for can_id in ids["theirs"]]
        for done in work:
            done.result()
    for end, messages in heard.items():
        in_bus_order = sorted(messages, key=lambda m: m.timestamp)
        for can_id in ids[end]:
            payloads = [bytes(m.data) for m in in_bus_order if m.arbitration_id == can_id]
            sent = [2 * (can_id.to_bytes(2, "big") + n.to_bytes(2, "big")) for n in range(count)]
            assert payloads == sent
        assert len(messages) == 4 * count
    assert hub.dropped == 0


def test_a_notifier_serves_listeners_and_functions(hub):
    called: list[can.Message] = []
    reader = can.BufferedReader()
    with open_bus() as sender, open_bus() as receiver:
        with can.Notifier(receiver, [reader, called.append], timeout=0.01):
            for number in range(100):
                sender.send(message(data=bytes([number])))
            assert numbers([reader.get_message(SAFETY_NET_S) for _ in range(100)]) == list(range(100))
            wait_until(lambda: len(called) == 100, "the function has been called for each")
        assert numbers(called) == list(range(100))
        sender.send(message(data=b"\xff"))  # the bus outlives its notifier
        assert numbers(hear(receiver, 1)) == [0xFF]


def test_an_asyncio_reader_gets_every_frame_of_a_burst(hub):
    """The loop reads once each time the descriptor is readable, so no frame may wait anywhere else."""

    async def listen(receiver: can.BusABC) -> list[can.Message]:
        reader = can.AsyncBufferedReader()
        with can.Notifier(receiver, [reader], loop=asyncio.get_running_loop()):
            return [await asyncio.wait_for(reader.get_message(), SAFETY_NET_S) for _ in range(500)]

    with open_bus() as sender, open_bus() as receiver:
        for number in range(500):
            sender.send(message(data=number.to_bytes(2, "big")))
        assert numbers(asyncio.run(listen(receiver))) == list(range(500))


def test_a_periodic_message_comes_until_its_duration_is_over(hub):
    with open_bus() as sender, open_bus() as receiver:
        task = sender.send_periodic(message(), period=0.005, duration=0.05)
        assert receiver.recv(SAFETY_NET_S).arbitration_id == 0x123
        wait_until(lambda: not task.thread.is_alive(), "the duration is over")
        assert task.stopped


def test_a_periodic_message_can_be_modified_and_stopped(hub):
    with open_bus() as sender, open_bus() as receiver:
        task = sender.send_periodic(message(data=b"\x01"), period=0.005)
        first = hear(receiver, 3)
        assert numbers(first) == [1, 1, 1]
        task.modify_data(message(data=b"\x02"))
        wait_until(lambda: numbers(hear(receiver, 1)) == [2], "the new data come")
        assert numbers(hear(receiver, 3)) == [2, 2, 2]
        task.stop()
        wait_until(lambda: not task.thread.is_alive(), "its thread has ended")
        sender.send(message(0x124))
        wait_until(lambda: receiver.recv(SAFETY_NET_S).arbitration_id == 0x124, "the last has come")
        assert receiver.recv(0.02) is None


def test_shutdown_stops_all_periodic_messages(hub):
    with open_bus() as receiver:
        with open_bus() as sender:
            tasks = [sender.send_periodic(message(can_id), period=0.2) for can_id in (0x123, 0x124)]
            assert {receiver.recv(SAFETY_NET_S).arbitration_id for _ in tasks} == {0x123, 0x124}
        assert all(task.stopped for task in tasks)
        wait_until(lambda: not any(task.thread.is_alive() for task in tasks), "their threads have ended")


def test_what_was_sent_reaches_the_bus_though_the_sender_leaves_at_once(hub):
    with open_bus() as receiver:
        with open_bus() as sender:
            for number in range(100):
                sender.send(message(data=bytes([number])))
        assert numbers(hear(receiver, 100)) == list(range(100))


def test_what_was_sent_reaches_the_bus_though_the_sender_leaves_without_listening(hub):
    with open_bus() as receiver:
        with open_bus() as sender:
            receiver.send(message(0x7FF))
            assert select.select([sender], [], [], SAFETY_NET_S)[0] == [sender]
            for number in range(100):
                sender.send(message(data=bytes([number])))
        assert numbers(hear(receiver, 100)) == list(range(100))


def test_sending_to_a_busy_hub_gives_up_after_the_timeout():
    with stalled_hub() as (bus, _), pytest.raises(can.CanTimeoutError, match="took no frame within"):
        send_for_ever(bus, timeout=0.01)


def test_a_readable_descriptor_says_that_a_frame_is_there(hub):
    with open_bus() as sender, open_bus() as receiver:
        assert select.select([receiver], [], [], 0.0) == ([], [], [])
        sender.send(message())
        assert select.select([receiver], [], [], SAFETY_NET_S)[0] == [receiver]
        assert receiver.recv(0.0) is not None


def test_options_that_tools_pass_are_taken(hub):
    timing = can.BitTiming.from_sample_point(f_clock=8_000_000, bitrate=1_000_000, sample_point=75.0)
    for bit_rate in ({"bitrate": 1_000_000}, {"timing": timing}):
        open_bus(single_handle=True, fd=False, receive_own_messages=False, **bit_rate).shutdown()


def test_a_channel_may_have_a_number_for_a_name():
    with serving("7"), can.Bus(interface="hilbus", channel="7") as bus:
        assert bus.channel_info.startswith("hilbus channel '7'")


def test_shutdown_may_be_called_twice(hub):
    bus = open_bus()
    bus.shutdown()
    bus.shutdown()


def test_a_context_leaves_the_bus_whatever_ends_it(hub):
    with pytest.raises(KeyError), open_bus() as bus:
        raise KeyError
    assert bus.fileno() == -1


# configuration


@pytest.fixture
def no_configuration(tmp_path, monkeypatch):
    """A home without configuration files."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    return tmp_path


def test_a_bus_can_be_named_in_the_user_s_configuration_file(hub, no_configuration):
    (no_configuration / ".canrc").write_text(
        "[default]\ninterface = hilbus\nchannel = test\nbitrate = 1000000\n"
    )
    with can.Bus() as bus:
        assert bus.channel_info.startswith("hilbus channel 'test'")


def test_a_bus_can_be_named_in_the_environment(hub, no_configuration, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "hilbus")
    monkeypatch.setenv("CAN_CHANNEL", "test")
    with can.Bus() as bus:
        assert bus.channel_info.startswith("hilbus channel 'test'")
    monkeypatch.setenv("CAN_BITRATE", "250000")
    with pytest.raises(can.CanInitializationError, match="1000000 bit/s, not at 250000"):
        can.Bus()


# what it refuses


@pytest.mark.parametrize(
    "refused",
    [
        can.Message(arbitration_id=1, is_remote_frame=True),
        can.Message(is_error_frame=True),
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=0x2000_0000, is_extended_id=True),
        can.Message(arbitration_id=-1),
        can.Message(arbitration_id=1, dlc=9),
        can.Message(arbitration_id=1, data=b"\x00" * 9),
        can.Message(arbitration_id=1, data=b"\x01\x02", dlc=1),
    ],
    ids=["remote", "error", "12-bit id", "30-bit id", "negative", "dlc 9", "9 bytes", "beyond dlc"],
)
def test_other_frames_than_data_frames_are_refused_and_do_no_harm(hub, refused):
    with open_bus() as sender, open_bus() as receiver:
        with pytest.raises(can.CanOperationError, match=r"only data frames|no classic frame"):
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


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        ({"bitrate": 500_000}, "runs at 1000000 bit/s, not at 500000"),
        (
            {
                "timing": can.BitTiming.from_sample_point(
                    f_clock=8_000_000, bitrate=500_000, sample_point=75.0
                )
            },
            "runs at 1000000 bit/s, not at 500000",
        ),
        ({"receive_own_messages": True}, "a second bus on the channel"),
    ],
    ids=["bit rate", "timing", "own messages"],
)
def test_what_the_bus_does_not_offer_is_refused_rather_than_ignored(hub, asked, what):
    with pytest.raises(can.CanInitializationError, match=what) as error:
        open_bus(**asked)
    assert "\n" not in str(error.value)


def test_a_bus_without_a_channel_is_refused(no_configuration):
    with pytest.raises(can.CanInitializationError, match="hil bus --channel"):
        can.Bus(interface="hilbus")


# ends


def test_a_hub_that_ends_is_noticed_by_sender_and_receiver():
    with serving("test"):
        bus = open_bus()
    with bus:
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="the hub has ended"):
                bus.send(message())
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="the hub has ended"):
                bus.recv(SAFETY_NET_S)
        with pytest.raises(can.CanOperationError, match="the hub has ended"):
            bus.send(message())


def test_a_killed_hub_is_noticed_in_one_line_by_sender_and_receiver():
    with background("hil", "bus", "--channel", "test") as hub:
        assert "hilbus channel 'test'" in hub.stdout.readline()
        sender, receiver = open_bus(), open_bus()
        hub.kill()
        hub.wait()
        with sender, pytest.raises(can.CanOperationError) as at_sender:
            sender.send(message())
        with receiver, pytest.raises(can.CanOperationError) as at_receiver:
            receiver.recv(None)
    assert str(at_sender.value) == "cannot send on hilbus channel 'test', 1000000 bit/s: the hub has ended"
    assert (
        str(at_receiver.value) == "cannot receive on hilbus channel 'test', 1000000 bit/s: the hub has ended"
    )


def test_what_the_hub_sent_before_it_ended_is_received_though_it_did_not_take_all_of_ours():
    with stalled_hub() as (bus, connection):
        bus.send(message())
        for number in range(3):
            connection.send(link.pack_timed(number, Frame(0x123, 1, number)))
        connection.close()
        assert numbers(hear(bus, 3)) == [0, 1, 2]
        with pytest.raises(can.CanOperationError, match="the hub has ended"):
            bus.recv(SAFETY_NET_S)


def test_an_asyncio_loop_is_told_once_that_the_hub_has_ended():
    reported: list[Exception] = []

    async def outlive_the_hub() -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: reported.append(context["exception"]))
        with serving("test"):
            bus = open_bus()
            notifier = can.Notifier(bus, [], loop=loop)
        while not reported:
            await asyncio.sleep(0.01)
        for _ in range(100):
            await asyncio.sleep(0)
        notifier.stop()
        bus.shutdown()

    asyncio.run(asyncio.wait_for(outlive_the_hub(), SAFETY_NET_S))
    assert [str(error) for error in reported] == [
        "cannot receive on hilbus channel 'test', 1000000 bit/s: the hub has ended"
    ]


def test_a_bus_that_was_shut_down_neither_sends_nor_receives(hub):
    bus = open_bus()
    bus.shutdown()
    for use in (lambda: bus.send(message()), lambda: bus.recv(0.01), lambda: bus.recv(None)):
        with pytest.raises(can.CanOperationError, match="the bus was shut down"):
            use()
    assert bus.fileno() == -1


@pytest.mark.parametrize(
    "use", [lambda bus: bus.recv(None), lambda bus: bus.send(message())], ids=["recv", "send"]
)
def test_shutdown_wakes_a_thread_that_waits(use):
    """More than python-can promises; its ThreadSafeBus has shutdown wait for the receiver instead."""
    said = []

    def wait(bus: can.BusABC) -> None:
        try:
            use(bus)
        except can.CanOperationError as error:
            said.append(str(error))

    def waits() -> bool:
        frame = sys._current_frames().get(thread.ident)
        return frame is not None and frame.f_code.co_name in ("_recv_internal", "send")

    with stalled_hub() as (bus, _):
        with pytest.raises(can.CanTimeoutError):
            send_for_ever(bus, timeout=0.01)  # until there is no more room
        thread = Thread(target=wait, args=(bus,), daemon=True)
        thread.start()
        wait_until(waits, "the thread waits")
        bus.shutdown()
        thread.join(SAFETY_NET_S)
    assert len(said) == 1
    assert "the bus was shut down" in said[0]


# finding hubs


def test_running_hubs_are_detected_and_dead_sockets_are_not(hub, socket_directory):
    directory = link.socket_directory()
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dead.bind(os.fspath(directory / "dead.sock"))
    dead.close()
    assert can.detect_available_configs("hilbus") == [{"interface": "hilbus", "channel": "test"}]
    with open_bus():
        pass  # the probe did not upset the hub


def test_a_hub_that_greets_nobody_does_not_hold_up_the_search():
    with link.seqpacket_socket() as listener, link.seqpacket_socket() as first:
        listener.bind(os.fspath(link.socket_path("test")))
        listener.listen(0)
        first.connect(os.fspath(link.socket_path("test")))
        assert can.detect_available_configs("hilbus") == []


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


@contextmanager
def two_programs() -> Iterator[tuple[Hub, socket.socket, socket.socket]]:
    """A hub that is not running yet, and the links of two programs on its bus."""
    with (
        Hub(Wire(1_000_000), "test", expected=None) as hub,
        link.seqpacket_socket() as one,
        link.seqpacket_socket() as other,
    ):
        for end in (one, other):
            end.connect(os.fspath(link.socket_path("test")))
            link.send_json(end, {"version": link.PROTOCOL_VERSION, "role": "bus"})
            for _ in range(3):
                hub.service()
            assert link.receive_json(end)["virtual"] is False
        yield hub, one, other


def test_bus_time_in_wall_time_follows_the_clock_and_never_runs_ahead():
    """One frame per turn of the loop: each starts when it was sent, the last one never ends."""
    turns_ns = (0, 50_000_000, 51_000_000)
    clock_ns = origin_ns = 7_000_000_000
    frame = Frame(0x123, 3, 0x030201)
    with two_programs() as (hub, sender, receiver):

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


def test_a_frame_that_ends_between_two_looks_at_the_links_is_passed_on_before_the_hub_waits():
    """The clock is read before and after each wait: the frame must have come by the second reading."""
    readings: list[bool] = []
    with two_programs() as (hub, sender, receiver):
        receiver.setblocking(False)

        def clock_ns() -> int:
            try:
                readings.append(bool(receiver.recv(link.MAX_PACKET)))
            except BlockingIOError:
                readings.append(False)
            return now_ns

        def turns() -> Iterator[bool]:
            nonlocal now_ns
            sender.send(link.pack_frame(Frame(0x123, 3, 0x030201)))
            yield True  # the frame is taken
            readings.clear()
            now_ns += 1_000_000
            yield True  # it has ended
            yield False

        now_ns = 0
        hub.run_in_wall_time(turns().__next__, clock_ns)
    assert readings == [False, True]
