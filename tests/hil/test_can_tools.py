"""The tools of python-can and cantools on the embedded bus, each as its user starts it."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import cantools
import pytest
from bench_runs import SAFETY_NET_S, background, serving, wait_until

from dbc.contract import PACKAGED_DBC

BIN = Path(sys.executable).parent
ENDED = "the hub has ended"


@pytest.fixture(scope="module")
def live_directory(tmp_path_factory) -> Iterator[Path]:
    """Where the sockets are while `hil bus --channel live` runs."""
    directory = tmp_path_factory.mktemp("live")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        with background("hil", "bus", "--channel", "live") as hub:
            assert "hilbus channel 'live'" in hub.stdout.readline()
            yield directory


@pytest.fixture(autouse=True)
def environment(live_directory, tmp_path, monkeypatch) -> None:
    """A terminal, no configuration of the user's, output at once, and Ctrl-C as a shell's child gets it."""
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    settings = {"XDG_RUNTIME_DIR": live_directory, "HOME": tmp_path, "TERM": "xterm", "PYTHONUNBUFFERED": 1}
    for name, value in settings.items():
        monkeypatch.setenv(name, str(value))
    signal.signal(signal.SIGINT, signal.default_int_handler)


def open_bus(channel: str = "live", fd: bool = False) -> can.BusABC:
    return can.Bus(interface="hilbus", channel=channel, fd=fd)


class Terminal:
    """A program on a terminal of its own."""

    def __init__(self, *command: str | Path) -> None:
        self.seen = ""
        self._end, theirs = pty.openpty()
        termios.tcsetwinsize(theirs, (40, 120))
        self._program = subprocess.Popen(
            command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *_: object) -> None:
        self._program.kill()
        self._program.wait()
        os.close(self._end)

    def shows(self, text: str) -> bool:
        """Tell whether a text has been on the screen."""
        while select.select([self._end], [], [], 0.0)[0]:
            try:
                self.seen += os.read(self._end, 65536).decode()
            except OSError:  # the program has ended
                break
        return text in self.seen

    def press(self, key: str) -> None:
        os.write(self._end, key.encode())

    def exit_code(self) -> int:
        """Wait for the program's end; what it wrote last is in `seen`."""
        wait_until(lambda: self.shows("") and self._program.poll() is not None, "the program has ended")
        self.shows("")
        return self._program.returncode


Content = tuple[tuple[int, bool], tuple[bytes, bool, bool, bool]]


def content(message: can.Message) -> Content:
    kind = message.is_fd, message.bitrate_switch, message.error_state_indicator
    return (message.arbitration_id, message.is_extended_id), (bytes(message.data), *kind)


def by_id(contents: list[Content]) -> dict[tuple[int, bool], list[tuple[bytes, bool, bool, bool]]]:
    """Return what each identifier carried in its order; between identifiers arbitration decides."""
    carried = defaultdict(list)
    for can_id, rest in contents:
        carried[can_id].append(rest)
    return carried


def send_until(bus: can.BusABC, happened, what: str, *messages: can.Message) -> None:
    """Send frames again and again until something is true."""

    def once_more() -> bool:
        for message in messages:
            bus.send(message)
        return happened()

    wait_until(once_more, what)


def shows(text: str, terminal: Terminal):
    return lambda: terminal.shows(text)


FRAMES = [
    can.Message(arbitration_id=can_id, is_extended_id=extended, data=bytes([number] * length))
    for number, length in enumerate((0, 1, 3, 8))
    for can_id, extended in ((0x000, False), (0x123, False), (0x7FF, False), (0x1FFF_FFFF, True))
]
FD_FRAMES = [
    can.Message(
        arbitration_id=0x456,
        is_extended_id=False,
        data=bytes(range(length)),
        is_fd=True,
        bitrate_switch=length % 8 == 0,
        error_state_indicator=length == 64,
    )
    for length in can.util.CAN_FD_DLC
]
FILLER = can.Message(arbitration_id=0x700, is_extended_id=False, data=b"filler")


@pytest.mark.parametrize(
    ("options", "frames"), [((), FRAMES), (("--fd",), FRAMES + FD_FRAMES)], ids=["classic", "CAN FD"]
)
def test_can_logger_logs_what_is_sent_and_can_player_replays_what_was_logged(tmp_path, options, frames):
    log = tmp_path / "bus.log"
    bus = ("-i", "hilbus", "-c", "live", *options)
    with background("can.logger", *bus, "-f", str(log)) as logger, open_bus(fd=True) as sender:
        assert "hilbus channel 'live', 1000000 bit/s" in logger.stdout.readline()
        assert "Started" in logger.stdout.readline()
        for message in frames:
            sender.send(message)
        send_until(
            sender, lambda: log.exists() and log.stat().st_size, "the log is written in part", *[FILLER] * 20
        )
        logger.send_signal(signal.SIGINT)
        assert (logger.wait(SAFETY_NET_S), logger.stderr.read()) == (0, "")
    logged = [content(message) for message in can.LogReader(log)]
    assert by_id([c for c in logged if c != content(FILLER)]) == by_id([content(m) for m in frames])

    with open_bus(fd=True) as listener, background("can.player", *bus, str(log)) as player:
        heard = [content(listener.recv(SAFETY_NET_S)) for _ in logged]
        assert (player.wait(SAFETY_NET_S), player.stderr.read()) == (0, "")
    assert by_id(heard) == by_id(logged)


@pytest.mark.parametrize(
    ("viewer", "key"), [([BIN / "can_viewer"], "q"), ([sys.executable, "-m", "can.viewer"], "\x1b")]
)
def test_can_viewer_shows_identifiers_and_data_and_ends_with_a_key(viewer, key):
    shown = can.Message(arbitration_id=0x2A5, is_extended_id=False, data=b"\xca\xfe")
    with Terminal(*viewer, "-i", "hilbus", "-c", "live") as terminal, open_bus() as sender:
        send_until(sender, shows("0x2A5", terminal), "the identifier is shown", shown)
        assert wait_until(shows("CA FE", terminal), "the data are shown")
        terminal.press(key)
        assert terminal.exit_code() == 0
        assert "Traceback" not in terminal.seen


@pytest.fixture
def pressures() -> can.Message:
    """One of our messages, with zero pressures."""
    contract = cantools.database.load_file(PACKAGED_DBC).get_message_by_name("PressureFeedback")
    return can.Message(
        arbitration_id=contract.frame_id,
        is_extended_id=contract.is_extended_frame,
        data=bytes(contract.length),
    )


def test_cantools_monitor_shows_our_messages_by_name(pressures):
    with (
        Terminal(BIN / "cantools", "monitor", "-i", "hilbus", "-c", "live", PACKAGED_DBC) as terminal,
        open_bus() as sender,
    ):
        send_until(sender, shows("PressureFeedback(", terminal), "the message is shown", pressures)
        for name in ("PressureA", "PressureB", "PressureAccumulator"):
            assert wait_until(shows(f"{name}: 0.0", terminal), f"{name} is shown")
        terminal.press("q")
        assert terminal.exit_code() == 0
        assert "Traceback" not in terminal.seen


# without a hub


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-c", "nowhere"], "no hub on hilbus channel 'nowhere': start one with `hil bus --channel nowhere`"),
        (["-c", "live", "-b", "500000"], "runs at 1000000 bit/s, not at 500000"),
    ],
    ids=["no hub", "another bit rate"],
)
def test_a_tool_that_cannot_attach_says_why(options, said):
    with background("can.logger", "-i", "hilbus", *options) as logger:
        assert logger.wait(SAFETY_NET_S) != 0
        errors = logger.stderr.read()
    assert said in errors
    assert "FileNotFoundError" not in errors


# A hub that ends looks as an interface that goes down does on SocketCAN: a CanOperationError in the tool.


@pytest.fixture
def short() -> Iterator[ExitStack]:
    """A hub on channel "short" for as long as the stack is not closed."""
    with ExitStack() as lifetime:
        lifetime.enter_context(serving("short"))
        yield lifetime


def test_can_logger_ends_with_the_hub_and_leaves_a_whole_log(short, tmp_path):
    log = tmp_path / "bus.log"
    with background("can.logger", "-i", "hilbus", "-c", "short", "-f", str(log)) as logger:
        assert "hilbus" in logger.stdout.readline()
        with open_bus("short") as sender, open_bus("short") as listener:
            for message in FRAMES:
                sender.send(message)
            heard = [content(listener.recv(SAFETY_NET_S)) for _ in FRAMES]
        short.close()
        assert logger.wait(SAFETY_NET_S) == 1
        assert ENDED in logger.stderr.read().splitlines()[-1]
    assert [content(message) for message in can.LogReader(log)] == heard


def test_can_player_ends_with_the_hub(short, tmp_path):
    log = tmp_path / "long.log"
    with can.Logger(log) as writer:
        for number in range(10_000):
            writer(can.Message(timestamp=number * 0.05, arbitration_id=1, is_extended_id=False))
    with background("can.player", "-i", "hilbus", "-c", "short", str(log)) as player:
        with open_bus("short") as listener:
            assert listener.recv(SAFETY_NET_S) is not None
        short.close()
        assert player.wait(SAFETY_NET_S) == 1
        assert ENDED in player.stderr.read().splitlines()[-1]


def test_can_viewer_ends_with_the_hub_and_gives_the_terminal_back(short):
    with Terminal(BIN / "can_viewer", "-i", "hilbus", "-c", "short") as terminal:
        with open_bus("short") as sender:
            send_until(sender, shows("0x700", terminal), "the identifier is shown", FILLER)
        short.close()
        assert terminal.exit_code() == 1
    _, restored, after = terminal.seen.rpartition("\x1b[?1049l")
    assert restored
    assert ENDED in after.splitlines()[-1]


def test_cantools_monitor_keeps_its_picture_when_the_hub_ends_and_says_so(short, pressures):
    monitor = [BIN / "cantools", "monitor", "-i", "hilbus", "-c", "short", PACKAGED_DBC]
    with Terminal(*monitor) as terminal:
        with open_bus("short") as sender:
            send_until(sender, shows("PressureFeedback(", terminal), "the message is shown", pressures)
        short.close()
        assert wait_until(shows(ENDED, terminal), "the end is shown")
        terminal.press("q")
        assert terminal.exit_code() == 0
