"""`hil vcan status` on made-up machines: one line on whether SocketCAN is usable, and what to type next."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from hil import cli
from hil.bus.socketcan import SocketcanStatus, socketcan_status

ETHERNET, CAN = 1, 280
DOWN, UP = 0x80, 0x81


def fails_with(number: int) -> Callable[[], None]:
    def open_raw_socket() -> None:
        raise OSError(number, os.strerror(number))

    return open_raw_socket


def works() -> None:
    pass


class Machine:
    """Folders that look like a machine's /sys/class/net and /lib/modules/RELEASE."""

    def __init__(self, root: Path) -> None:
        self.devices = root / "net"
        self.modules = root / "modules"
        self.add("lo", 772, UP)
        self.add("eth0", ETHERNET, UP)
        (self.devices / "bonding_masters").write_text("")

    def add(self, name: str, kind: int, flags: int, is_hardware: bool = False) -> None:
        device = self.devices / name
        device.mkdir(parents=True)
        (device / "type").write_text(f"{kind}\n")
        (device / "flags").write_text(f"{flags:#x}\n")
        if is_hardware:
            (device / "device").mkdir()

    def add_module(self, path: str) -> None:
        file = self.modules / path
        file.parent.mkdir(parents=True)
        file.write_bytes(b"")

    def status(self, open_raw_socket: Callable[[], None], system: str = "linux") -> SocketcanStatus:
        status = socketcan_status(system, open_raw_socket, self.devices, self.modules)
        assert "\n" not in status.line
        return status


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_another_system_than_linux(machine):
    status = machine.status(works, system="darwin")
    assert not status.usable
    assert "needs Linux: use `hil run sine --mode inprocess`" in status.line


@pytest.mark.parametrize("number", [errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT])
def test_a_kernel_that_has_the_modules_but_has_not_loaded_them(machine, number):
    machine.add_module("kernel/drivers/net/can/vcan.ko.zst")
    status = machine.status(fails_with(number))
    assert not status.usable
    assert status.line.endswith("type `sudo modprobe -a can-raw vcan`")


def test_a_kernel_without_socketcan(machine):
    status = machine.status(fails_with(errno.EAFNOSUPPORT))
    assert not status.usable
    assert "this kernel has no SocketCAN" in status.line
    for way_out in ("`hil run sine --mode realtime`", "`-i hilbus`", "`make test-vcan`"):
        assert way_out in status.line


@pytest.mark.parametrize("number", [errno.EPERM, errno.EACCES])
def test_a_container_that_forbids_it(machine, number):
    machine.add("can0", CAN, UP)
    status = machine.status(fails_with(number))
    assert not status.usable
    assert status.line.startswith(f"{os.strerror(number)}: CAN sockets are not permitted here")


def test_any_other_reason_is_passed_on(machine):
    status = machine.status(fails_with(errno.EMFILE))
    assert not status.usable
    assert "no CAN socket can be opened (Too many open files)" in status.line


def test_no_interface(machine):
    status = machine.status(works)
    assert not status.usable
    assert "`sudo ip link add dev vcan0 type vcan && sudo ip link set up vcan0`" in status.line


def test_a_virtual_interface_that_is_down(machine):
    machine.add("vcan0", CAN, DOWN)
    status = machine.status(works)
    assert not status.usable
    assert status.line.endswith("down: vcan0; type `sudo ip link set vcan0 up`")


def test_an_adapter_that_is_down_needs_a_bit_rate_too(machine):
    machine.add("can0", CAN, DOWN, is_hardware=True)
    machine.add("vcan0", CAN, DOWN)
    status = machine.status(works)
    assert not status.usable
    assert status.line.endswith("down: can0, vcan0; type `sudo ip link set can0 up type can bitrate 1000000`")


def test_usable(machine):
    machine.add("can0", CAN, DOWN, is_hardware=True)
    machine.add("vcan0", CAN, UP)
    machine.add("vcan1", CAN, UP)
    status = machine.status(works)
    assert status.usable
    assert "up: vcan0, vcan1; type `hil run sine --mode realtime -i socketcan -c vcan0`" in status.line


def test_the_command_answers_for_this_machine(capsys):
    expected = socketcan_status()
    code = cli.main(["vcan", "status"])
    said = capsys.readouterr()
    assert (code, said.out, said.err) == (0 if expected.usable else 1, f"{expected.line}\n", "")
