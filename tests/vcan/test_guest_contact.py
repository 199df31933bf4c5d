"""What the tests in a guest rely on, seen from inside it: a vcan0 that carries frames between processes."""

import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

CHANNEL = "vcan0"
TIMEOUT_S = 30.0
ARPHRD_CAN = 280
IFF_UP = 1
GUEST_RUNNER = Path(__file__).with_name("guest.py")

ECHO = f"""
import can
with can.Bus(interface="socketcan", channel="{CHANNEL}") as bus:
    print("ready", flush=True)
    while (frame := bus.recv()).dlc:
        bus.send(can.Message(arbitration_id=frame.arbitration_id + 1, data=frame.data, is_extended_id=False))
"""


def frame(data: bytes) -> can.Message:
    return can.Message(arbitration_id=0x123, data=data, is_extended_id=False)


@pytest.fixture
def bus() -> Iterator[can.BusABC]:
    with can.Bus(interface="socketcan", channel=CHANNEL) as bus:
        yield bus


@pytest.mark.parametrize(("name", "hardware_type"), [(CHANNEL, ARPHRD_CAN), ("lo", 772)])
def test_the_interfaces_are_up(name: str, hardware_type: int) -> None:
    device = Path("/sys/class/net", name)
    assert int((device / "type").read_text()) == hardware_type
    assert int((device / "flags").read_text(), 16) & IFF_UP


def test_frames_travel_between_two_processes_and_back(bus: can.BusABC) -> None:
    with subprocess.Popen([sys.executable, "-c", ECHO], stdout=subprocess.PIPE) as echo:
        assert echo.stdout is not None
        echo.stdout.readline()
        for number in range(100):
            payload = number.to_bytes(8, "big")
            bus.send(frame(payload))
            answer = bus.recv(TIMEOUT_S)
            assert answer is not None
            assert (answer.arbitration_id, bytes(answer.data)) == (0x124, payload)
        bus.send(frame(b""))
        assert echo.wait(TIMEOUT_S) == 0


def test_candump_sees_a_frame(bus: can.BusABC) -> None:
    candump = ["candump", "-L", "-n", "1", "-T", f"{TIMEOUT_S * 1e3:.0f}", f"{CHANNEL},7DF:7FF"]
    with subprocess.Popen(candump, stdout=subprocess.PIPE, text=True) as dump:
        wait_for_receiver_of("7df")
        bus.send(can.Message(arbitration_id=0x7DF, data=b"\xde\xad\xbe\xef", is_extended_id=False))
        output, _ = dump.communicate()
    assert re.fullmatch(r"\(\d+\.\d{6}\) vcan0 7DF#DEADBEEF\n", output)


def wait_for_receiver_of(identifier: str) -> None:
    """Wait until a process listens to one CAN identifier; the kernel lists such receivers."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while not re.search(rf"{CHANNEL}\s+{identifier}\b", Path("/proc/net/can/rcvlist_fil").read_text()):
        assert time.monotonic() < deadline_s, f"nobody listens to {identifier}"
        time.sleep(0.01)


def test_a_burst_of_5000_frames_is_not_lost(bus: can.BusABC) -> None:
    with can.Bus(interface="socketcan", channel=CHANNEL) as sender:
        for number in range(5000):
            sender.send(frame(number.to_bytes(2, "big")))
    received = [bus.recv(TIMEOUT_S) for _ in range(5000)]
    assert [int.from_bytes(message.data, "big") for message in received if message] == list(range(5000))


def test_the_kernel_sends_periodic_frames(bus: can.BusABC) -> None:
    with can.Bus(interface="socketcan", channel=CHANNEL) as sender:
        sender.send_periodic(frame(b"\x01"), period=0.01)
        assert all(bus.recv(TIMEOUT_S) for _ in range(3))


def test_packet_sockets_work_in_the_temporary_directory(tmp_path: Path) -> None:
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client,
    ):
        server.bind(str(tmp_path / "socket"))
        server.listen()
        client.connect(str(tmp_path / "socket"))
        client.send(b"one")
        client.send(b"two")
        connection, _ = server.accept()
        with connection:
            assert [connection.recv(100), connection.recv(100)] == [b"one", b"two"]


def test_where_a_vcan0_exists_the_runner_needs_no_guest() -> None:
    command = [sys.executable, str(GUEST_RUNNER), "--native", "--", "sh", "-c", "exit 3"]
    assert subprocess.run(command).returncode == 3
