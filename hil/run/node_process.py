"""The command line and main loop that every node process shares."""

import argparse
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import can

from dbc.contract import ContractError
from dbc.node import NOTHING, Node
from dbc.packet import FRAME, answers_of, pack_actions_into
from dbc.record import Record
from hil.bus import link
from hil.bus.hilbus import HilBus
from hil.bus.link import LinkError
from hil.bus.opening import bus_settings, open_bus
from hil.bus.wire import Clock
from hil.run.arguments import ratio
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
    parser.epilog = "What -i, -c and -b leave open comes from python-can's configuration, e.g. ~/.canrc."
    parser.add_argument(
        "--rt-ratio", type=ratio, default=Fraction(1), metavar="R", help="node time per wall time"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="write NAME.npz there at the end")
    parser.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the packaged ddh.dbc")
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)


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
        settings = bus_settings(arguments.interface, arguments.channel, arguments.bitrate)
        if settings.interface == "hilbus":
            connection, answer = _attach(settings.channel, node)
            if answer["virtual"]:
                with _recorded(node, arguments.record):
                    serve(node, connection, settings.channel, arguments.record)
            else:
                bus: can.BusABC = HilBus(settings.channel, greeted=(connection, answer))
                _run_in_wall_time(node, bus, arguments, clock)
        else:
            _run_in_wall_time(node, open_bus(*settings), arguments, clock)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except (DuplicateNodeError, can.CanInitializationError) as error:
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


def serve(node: RecordingNode, connection: socket.socket, channel: str, record: Path | None) -> None:
    """Answer the hub's events in virtual time until it says stop; save the record when it says so.

    Raises
    ------
    LinkError
        If the hub goes away without saying so.
    """
    packet, answer = memoryview(bytearray(link.MAX_PACKET)), bytearray(link.MAX_PACKET)
    view, receive, send = memoryview(answer), connection.recv_into, connection.send
    answer_to, nothing_into = answers_of(node), partial(pack_actions_into, actions=NOTHING)
    with connection:
        while True:
            try:
                length = receive(packet)
            except OSError:
                length = 0
            if not length:
                raise LinkError(
                    f"the hub of channel {channel!r} ended without a stop: is the bench still there?"
                )
            kind = packet[0]  # the least significant byte
            if kind <= FRAME:
                send(view[: answer_to(packet[:length], answer) or nothing_into(answer)])
                continue
            if kind == link.STOP:
                return
            if kind == link.SAVE and record is not None:
                node.record.save(record / f"{node.name}.npz")
            elif kind == link.FORGET:
                node.record.clear()
            send(view[: nothing_into(answer)])


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
