"""Which bus is opened: the command line, then python-can's own configuration; and what if it fails."""

import errno
import json
import signal
from pathlib import Path

import can
import pytest
from bench_runs import SAFETY_NET_S, background, serving
from can.interfaces.virtual import VirtualBus

from hil import cli
from hil.bus.hilbus import HilBus
from hil.bus.opening import bus_settings, open_bus
from hil.bus.socketcan import OutlivesInterruptions
from hil.run.node_processes import side_arguments
from hil.run.options import SIDES, RigOptions


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An account without any configuration of CAN buses, but what a test writes."""
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def write_canrc(home: Path, **settings: object) -> None:
    lines = (f"{key} = {value}\n" for key, value in settings.items())
    (home / ".canrc").write_text("[default]\n" + "".join(lines))


# which bus is meant


def test_the_command_line_alone():
    assert bus_settings("socketcan", "can0", 500_000) == ("socketcan", "can0", 500_000)


def test_nobody_names_a_bit_rate():
    assert bus_settings("socketcan", "can0", None).bit_rate is None


def test_the_configuration_file_alone(home):
    write_canrc(home, interface="pcan", channel="PCAN_USBBUS1", bitrate=250_000)
    assert bus_settings(None, None, None) == ("pcan", "PCAN_USBBUS1", 250_000)


def test_the_environment_alone(monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "kvaser")
    monkeypatch.setenv("CAN_CHANNEL", "0")
    monkeypatch.setenv("CAN_BITRATE", "1000000")
    assert bus_settings(None, None, None) == ("kvaser", "0", 1_000_000)


def test_the_command_line_prevails_over_the_environment_and_that_over_the_file(home, monkeypatch):
    write_canrc(home, interface="pcan", channel="PCAN_USBBUS1", bitrate=250_000)
    monkeypatch.setenv("CAN_CHANNEL", "PCAN_USBBUS2")
    assert bus_settings(None, None, 125_000) == ("pcan", "PCAN_USBBUS2", 125_000)


def test_no_interface_anywhere():
    with pytest.raises(can.CanInitializationError, match="No interface is configured: give -i and -c"):
        bus_settings(None, None, None)


def test_no_channel_anywhere():
    with pytest.raises(can.CanInitializationError, match="no channel for socketcan: give -i and -c"):
        open_bus("socketcan", None, None)


@pytest.mark.parametrize(
    "text", ["interface = socketcan\n", "[default]\n%\n", "[default]\nchannel = %(x)s\n"]
)
def test_a_configuration_file_that_is_malformed(home, text):
    (home / ".canrc").write_text(text)
    with pytest.raises(can.CanInitializationError, match=r"^[^\n]+: give -i and -c[^\n]+$"):
        bus_settings(None, None, None)


# opening it


def test_a_channel_that_is_a_number_is_given_to_the_adapter_as_one():
    with open_bus("virtual", "0", None) as ours, can.Bus(interface="virtual", channel=0) as other:
        ours.send(can.Message(arbitration_id=1))
        assert other.recv(SAFETY_NET_S) is not None


def test_what_only_this_adapter_has_comes_from_the_configuration(home):
    write_canrc(home, interface="virtual", channel="here", receive_own_messages=True)
    with open_bus(None, None, None) as bus:
        bus.send(can.Message(arbitration_id=1))
        assert bus.recv(SAFETY_NET_S) is not None


class Adapter(VirtualBus):
    """Remembers what it was opened with."""

    opened_with: dict[str, object]

    def __init__(self, channel, **settings):
        Adapter.opened_with = settings
        super().__init__(channel)


@pytest.mark.parametrize(
    ("given", "configured", "told"),
    [(None, None, {}), (None, 250_000, {"bitrate": 250_000}), (500_000, 250_000, {"bitrate": 500_000})],
)
def test_an_adapter_is_told_a_bit_rate_only_if_somebody_gave_one(home, monkeypatch, given, configured, told):
    monkeypatch.setitem(can.interfaces.BACKENDS, "virtual", (__name__, "Adapter"))
    if configured:
        write_canrc(home, bitrate=configured)
    with open_bus("virtual", "here", given):
        assert Adapter.opened_with == told


@pytest.mark.parametrize("name", ["0", "test"])
def test_the_embedded_bus_takes_any_channel_name(name):
    with serving(name), open_bus("hilbus", name, None) as bus:
        assert isinstance(bus, HilBus)
        assert bus.channel == name


@pytest.mark.parametrize("interface", ["pcan", "kvaser", "slcan", "gs_usb", "vector", "ixxat", "neovi"])
def test_an_adapter_whose_driver_is_not_here_is_refused_with_one_line(interface, capsys):
    with pytest.raises(can.CanInitializationError) as refused:
        open_bus(interface, "0", 1_000_000)
    line = str(refused.value)
    assert line.startswith(f"cannot open {interface} channel 0 (")
    assert line.endswith("check -i, -c and the adapter's driver (docs/real-hardware.md)")
    assert "\n" not in line
    assert capsys.readouterr().err == ""


def test_socketcan_that_cannot_be_opened_points_to_the_command_that_says_why(capsys):
    with pytest.raises(can.CanInitializationError, match=r"`hil vcan status` says what is missing$"):
        open_bus("socketcan", "nosuch0", None)
    assert capsys.readouterr().err == ""


# the programs


@pytest.mark.parametrize("module", ["plant_sim", "firmware_py"])
def test_a_side_started_with_nothing_but_the_environment(monkeypatch, module):
    monkeypatch.setenv("CAN_INTERFACE", "hilbus")
    monkeypatch.setenv("CAN_CHANNEL", "test")
    assert_runs_on_the_embedded_bus(module)


def test_a_side_started_with_nothing_but_a_configuration_file(home):
    write_canrc(home, interface="hilbus", channel="test")
    assert_runs_on_the_embedded_bus("plant_sim")


def assert_runs_on_the_embedded_bus(module: str) -> None:
    with serving("test"), background(module) as side:
        assert "is on hilbus channel 'test'" in side.stderr.readline()
        side.send_signal(signal.SIGTERM)
        side.communicate(timeout=SAFETY_NET_S)
        assert side.returncode == 0


def test_a_side_that_is_told_nothing(home):
    with background("plant_sim") as side:
        _, said = side.communicate(timeout=SAFETY_NET_S)
    assert side.returncode == 2
    assert said.startswith("python -m plant_sim: No interface is configured: give -i and -c")
    assert said.count("\n") == 1


def test_a_run_takes_channel_and_bit_rate_of_its_interface_from_the_configuration(home, capsys, tmp_path):
    write_canrc(home, channel="test", bitrate=500_000)
    run = ["run", "sine", "--mode", "realtime", "--rt-ratio", "0.1", "--duration", "0.05", "--json"]
    with serving("test", bit_rate=500_000):
        assert cli.main([*run, "-i", "hilbus", "--out", str(tmp_path / "out")]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["bit_rate"] == 500_000


def test_a_run_without_an_interface_is_on_a_bus_of_its_own_whatever_is_configured(home, tmp_path):
    write_canrc(home, interface="nosuch", channel="test")
    run = ["run", "sine", "--mode", "realtime", "--rt-ratio", "0.1", "--duration", "0.05"]
    assert cli.main([*run, "--out", str(tmp_path / "out")]) in (0, 1)


@pytest.mark.parametrize(("bit_rate", "arguments"), [(None, []), (500_000, ["-b", "500000"])])
def test_the_bench_hands_the_bit_rate_to_both_sides(tmp_path, bit_rate, arguments):
    options = RigOptions(record_directory=tmp_path)
    for side in SIDES:
        words = side_arguments(side, options, bus_settings("pcan", "PCAN_USBBUS1", bit_rate))
        assert words[words.index("-i") :][:4] == ["-i", "pcan", "-c", "PCAN_USBBUS1"]
        assert words[words.index("-b") :] == arguments if arguments else "-b" not in words


# an interface that is down for a while


class Cable(VirtualBus):
    """Fails with the errors it is given, then works."""

    def __init__(self, *errors: int | None) -> None:
        super().__init__("cable")
        self.errors = list(errors)

    def _fail(self) -> None:
        if self.errors and (number := self.errors.pop(0)) is not None:
            raise can.CanOperationError("as the kernel says", number)

    def send(self, msg, timeout=None):
        self._fail()
        super().send(msg, timeout)

    def _recv_internal(self, timeout):
        self._fail()
        return super()._recv_internal(timeout)


class SteadyCable(OutlivesInterruptions, Cable):
    pass


FRAME = can.Message(arbitration_id=0x123)


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENOBUFS])
def test_frames_are_lost_while_the_network_is_down_and_go_through_afterwards(number):
    with SteadyCable(number, number) as bus, VirtualBus("cable") as other:
        bus.send(FRAME)
        bus.send(FRAME)
        assert other.recv(0) is None
        bus.send(FRAME)
        assert other.recv(0) is not None


def test_an_interruption_is_reported_with_the_number_of_lost_frames(capsys, monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("hil.bus.socketcan.time.monotonic", lambda: now_s[0])
    with SteadyCable(errno.ENETDOWN, errno.ENETDOWN, errno.ENETDOWN) as bus:
        for _ in range(3):
            bus.send(FRAME)
        now_s[0] += 2.0
        bus.send(FRAME)
        bus.send(FRAME)
    assert capsys.readouterr().err.splitlines() == [
        f"{bus.channel_info}: Network is down; frames are lost until it is back",
        f"{bus.channel_info}: back, 3 frames could not be sent",
    ]


def test_a_queue_that_is_full_now_and_then_does_not_flood_the_screen(capsys):
    with SteadyCable(*[errno.ENOBUFS, None] * 500) as bus:
        for _ in range(1000):
            bus.send(FRAME)
    assert len(capsys.readouterr().err.splitlines()) < 20


def test_a_receiver_hears_nothing_while_the_network_is_down_and_goes_on_afterwards():
    with SteadyCable(errno.ENETDOWN) as bus, VirtualBus("cable") as other:
        assert bus.recv(0) is None
        other.send(FRAME)
        assert bus.recv(SAFETY_NET_S) is not None


@pytest.mark.parametrize("number", [errno.ENODEV, errno.ENXIO])
@pytest.mark.parametrize("act", [lambda bus: bus.send(FRAME), lambda bus: bus.recv(0)], ids=["send", "recv"])
def test_an_interface_that_was_removed_is_an_error(number, act):
    with SteadyCable(number) as bus, pytest.raises(can.CanOperationError, match="is gone: plug the adapter"):
        act(bus)


def test_other_errors_are_passed_on():
    with SteadyCable(errno.EINVAL) as bus, pytest.raises(can.CanOperationError, match="as the kernel says"):
        bus.send(FRAME)
