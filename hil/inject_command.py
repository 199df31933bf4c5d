"""``hil inject``: a fault into a bench that runs, and the side of ``hil bus`` that has it."""

import argparse
import sys
import time
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any

import can

from dbc.contract import Contract
from dbc.frame import Frame
from hil.bus import link
from hil.bus.agenda import Agenda
from hil.bus.hub import Hub
from hil.bus.messages import to_message
from hil.bus.opening import bus_settings, open_bus
from hil.faults.catalogue import fault_of_table, fault_of_text
from hil.faults.fault import Fault, FaultError, Stage
from hil.faults.sending import BenchSender
from hil.run.options import BenchError

EPILOG = """On hilbus: a lock-step run with `--channel` takes every fault and notes the bus time in
result.json; `hil bus` takes those of the wire and, like any other interface, those of sensor and machine.
at_s counts from now. `hil list --faults` shows the kinds."""

Action = Callable[[], None]


def add_command(commands: Any) -> None:
    """Add the command to a parser's commands."""
    inject = commands.add_parser(
        "inject",
        help="inject faults into a running bench",
        usage="hil inject CHANNEL KIND,KEY=VALUE,... [KIND,...] [-i INTERFACE]",
        epilog=EPILOG,
    )
    inject.set_defaults(command=_inject)
    inject.add_argument("channel", help=argparse.SUPPRESS)
    inject.add_argument("faults", nargs="+", help=argparse.SUPPRESS)
    inject.add_argument("-i", "--interface", default="hilbus", metavar="I", help="default hilbus")
    inject.add_argument(
        "-b", "--bitrate", type=int, metavar="B", help="not on hilbus: bit/s, for adapters that set it"
    )
    inject.add_argument(
        "--dbc", type=Path, metavar="FILE", help="not on hilbus: another DBC than the packaged ddh.dbc"
    )


def take_faults(hub: Hub) -> None:
    """Let a hub in wall time have faults: of the wire, and over the bench channel.

    Raises
    ------
    ContractError
        If the packaged DBC cannot be read.
    """
    contract = Contract.load()
    hub.agenda = Agenda(hub.wire, _tell)
    at = hub.agenda.at
    stage = Stage(contract, BenchSender(contract, at, hub.send), hub.wire, {}, at)

    def take(table: dict[str, Any]) -> None:
        fault_of_table(table).inject(stage, hub.wire.now_ns)

    hub.take_fault = take


def _tell(error: ValueError) -> None:
    print(f"hil: {error}", file=sys.stderr)


def _inject(arguments: argparse.Namespace) -> int:
    faults = [fault_of_text(text) for text in arguments.faults]
    if arguments.interface == "hilbus":
        for option, value in (("--dbc", arguments.dbc), ("--bitrate", arguments.bitrate)):
            if value is not None:
                raise BenchError(f"{option} {value}: on hilbus the bench that runs has its own: leave it out")
        for fault in faults:
            connection, answer = link.connect(arguments.channel, {"role": "fault", "fault": fault.table})
            connection.close()
            print(f"{fault.text} at bus time {answer['bus_time_s']:.6f} s")
    else:
        _send(faults, arguments)
    return 0


def _send(faults: list[Fault], arguments: argparse.Namespace) -> None:
    """Send what a supervisor would send, each frame when it is time; all at once when interrupted."""
    if virtual := [fault for fault in faults if fault.needs_virtual_time]:
        raise FaultError(f"{virtual[0].kind} needs a simulated wire: {arguments.interface} has none")
    contract = Contract.load(arguments.dbc)
    todo: list[tuple[int, Action]] = []
    with open_bus(*bus_settings(arguments.interface, arguments.channel, arguments.bitrate)) as bus:

        def send(frame: Frame) -> None:
            try:
                bus.send(to_message(0, frame, arguments.channel))
            except can.CanError as error:
                raise BenchError(f"cannot send on {bus.channel_info}: {error}") from error

        def at(time_ns: int, action: Action) -> None:
            todo.append((time_ns, action))

        stage = Stage(contract, BenchSender(contract, at, send), None, {}, at)
        for fault in faults:
            fault.inject(stage, 0)
        begin_s, waiting = time.monotonic(), True
        for time_ns, action in sorted(todo, key=itemgetter(0)):
            try:
                time.sleep(max(begin_s + time_ns / 1e9 - time.monotonic(), 0.0) if waiting else 0.0)
            except KeyboardInterrupt:
                waiting = False
            action()
