"""The command line and main loop that every node process shares."""

import argparse
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import can

from dbc.contract import ContractError
from dbc.node import Actions, Node
from dbc.record import Record
from hil.bus import link
from hil.bus.hilbus import HilBus
from hil.bus.link import LinkError
from hil.bus.wire import Clock
from hil.run.realtime import DuplicateNodeError, RealtimeNode
from hil.run.stopping import StopFlag, orphaned

EXIT_USAGE = 2
EXIT_BROKEN = 3


class RecordingNode(Node, Protocol):
    """A node that writes down what it saw of itself."""

    @property
    def record(self) -> Record:
        """Its rows."""


def add_node_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that both sides share; -i, -c and -b are python-can's."""
    parser.add_argument("-i", "--interface", metavar="I", help="python-can interface, e.g. socketcan, hilbus")
    parser.add_argument("-c", "--channel", metavar="C", help="its channel, e.g. vcan0")
    parser.add_argument("-b", "--bitrate", type=int, metavar="B", help="bit/s, for adapters that set it")
    parser.add_argument(
        "--rt-ratio", type=ratio, default=Fraction(1), metavar="R", help="node time per wall time"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="write NAME.npz there at the end")
    parser.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the packaged ddh.dbc")
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)


def ratio(text: str) -> Fraction:
    """Return a real-time ratio given as a decimal or a fraction.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not above 0 and at most 1.
    """
    try:
        value = Fraction(text)
    except (ValueError, ZeroDivisionError):
        value = Fraction(0)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0 and at most 1")
    return value


def node_main(
    parser: argparse.ArgumentParser,
    build: Callable[[argparse.Namespace], RecordingNode],
    clock: Clock,
    argv: list[str] | None,
) -> int:
    """Parse the arguments, run the node until it is stopped, and return the exit code."""
    arguments = parser.parse_args(argv)
    try:
        node = build(arguments)
    except (ContractError, ValueError) as error:
        return _complain(parser, error, EXIT_USAGE)
    try:
        if arguments.record:
            arguments.record.mkdir(parents=True, exist_ok=True)
        if arguments.interface == "hilbus" and arguments.channel:
            connection, answer = _attach(arguments.channel, node)
            if answer["virtual"]:
                with _recorded(node, arguments.record):
                    serve(node, connection, arguments.channel)
            else:
                bus: can.BusABC = HilBus(arguments.channel, greeted=(connection, answer))
                _run_in_wall_time(node, bus, arguments, clock)
        else:
            _run_in_wall_time(node, _open_bus(arguments), arguments, clock)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except (DuplicateNodeError, can.CanInitializationError, can.CanInterfaceNotImplementedError) as error:
        return _complain(parser, error, EXIT_USAGE)
    except (LinkError, can.CanError, OSError) as error:
        return _complain(parser, error, EXIT_BROKEN)
    return 0


@contextmanager
def _recorded(node: RecordingNode, directory: Path | None) -> Iterator[None]:
    """Save the node's record at the end, whatever ended it."""
    try:
        yield
    finally:
        if directory is not None:
            node.record.save(directory / f"{node.name}.npz")


def _open_bus(arguments: argparse.Namespace) -> can.BusABC:
    given = {key: getattr(arguments, key) for key in ("interface", "channel", "bitrate")}
    try:
        return can.Bus(**{key: value for key, value in given.items() if value is not None})
    except (can.CanError, OSError, ValueError, TypeError) as error:
        where = f"{arguments.interface or 'the configured interface'} channel {arguments.channel!r}"
        raise can.CanInitializationError(f"cannot open {where} ({error}): check -i and -c") from error


def serve(node: Node, connection: socket.socket, channel: str) -> None:
    """Answer the hub's events in virtual time until it says stop.

    Raises
    ------
    LinkError
        If the hub goes away without saying so.
    """
    with connection:
        while True:
            try:
                packet = connection.recv(link.MAX_PACKET)
            except OSError:
                packet = b""
            if not packet:
                raise LinkError(
                    f"the hub of channel {channel!r} ended without a stop: is the bench still there?"
                )
            kind, now_ns, frames = link.unpack_event(packet)
            if kind == link.STOP:
                return
            actions = Actions()
            for time_ns, frame in frames:
                actions = node.on_frame(time_ns, frame)
            if kind == link.TIMER:
                actions = node.on_timer(now_ns)
            elif kind == link.START:
                actions = node.on_start(now_ns)
            connection.send(link.pack_actions(actions))


def _attach(channel: str, node: Node) -> tuple[socket.socket, dict[str, Any]]:
    try:
        return link.connect(channel, _hello(node))
    except LinkError as error:
        raise can.CanInitializationError(str(error)) from error


def _hello(node: Node) -> dict[str, object]:
    return {
        "role": "node",
        "name": node.name,
        "accepts": None if node.accepts is None else sorted(node.accepts),
        "latched": sorted(node.latched),
        "transmits": sorted(node.transmits),
    }


def _run_in_wall_time(
    node: RecordingNode, bus: can.BusABC, arguments: argparse.Namespace, clock: Clock
) -> None:
    stopped = StopFlag.on_signals()

    def keep_running() -> bool:
        if orphaned(arguments.parent):
            raise LinkError("the bench that started this process has ended")
        return not stopped.is_set()

    with bus:
        runner = RealtimeNode(node, bus, arguments.rt_ratio, clock)
        runner.listen_for_duplicate()
        print(f"{node.name} is on {bus.channel_info}; Ctrl-C ends it", file=sys.stderr, flush=True)
        with _recorded(node, arguments.record):
            runner.start()
            runner.run(keep_running)
    late = runner.lateness.summary()
    print(
        f"{node.name}: timer late by {late['p50_us']:.0f} µs (median), {late['p99_us']:.0f} µs (p99), "
        f"{late['p999_us']:.0f} µs (p99.9), {late['max_us']:.0f} µs (max); "
        f"{late['overruns']} periods missed in {late['stalls']} stalls; scheduler {late['scheduler']}",
        file=sys.stderr,
    )


def _complain(parser: argparse.ArgumentParser, error: Exception, code: int) -> int:
    print(f"{parser.prog}: {error}", file=sys.stderr)
    return code
