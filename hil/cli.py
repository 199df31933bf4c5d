"""``hil``: the bench's command line."""

import argparse
import json
import signal
import sys
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path
from typing import Any

import can
from rich.console import Console
from rich.table import Table

from dbc.contract import ContractError
from firmware_py.calibration import CalibrationError
from firmware_py.chosen_firmware import FirmwareError, add_firmware_argument, firmware_of_text
from firmware_py.chosen_tuning import DEFAULT_TUNING, add_tuning_arguments, tuning_of
from firmware_py.tuning import TUNINGS
from hil import inject_command
from hil.bus.hub import Hub
from hil.bus.link import LinkError
from hil.bus.opening import bus_settings
from hil.bus.socketcan import socketcan_status
from hil.bus.wire import DEFAULT_DATA_BIT_RATE, Wire
from hil.faults.catalogue import fault_of_text, rows
from hil.faults.fault import FaultError
from hil.measure import METRICS, overrun_of, result_of, trace_of
from hil.picture import heading
from hil.progress import progress_bar
from hil.report import OutputDirectory
from hil.run.arguments import ratio
from hil.run.options import (
    DEFAULT_BIT_RATE,
    HUB_GREETING,
    INTERRUPTED,
    BenchError,
    InterruptedRunError,
    RunOptions,
    check_bit_rate,
    check_data_bit_rate,
)
from hil.run.rig import play
from hil.run.rigs import RIGS
from hil.run.stopping import StopFlag, orphaned
from hil.scenario import CONTROLLERS, ScenarioError, builtin_names, controller_of, load_scenario, too_late
from hil.study import (
    cost_command,
    faults_command,
    replay_command,
    reproduce,
    rta_command,
    sweep_command,
    tune_command,
)
from hil.study.box import BoxError
from hil.study.fault_matrix import MatrixError
from hil.supervisor import BRING_UP_S
from plant_sim.parameters import ParameterError

EXIT_OK, EXIT_LIMITS, EXIT_USAGE, EXIT_BROKEN = range(4)
EXIT_UNUSABLE = 1
EXIT_INTERRUPTED = 128 + signal.SIGINT

REFUSALS = (
    BenchError,
    BoxError,
    CalibrationError,
    can.CanInitializationError,
    ContractError,
    FaultError,
    FirmwareError,
    LinkError,
    MatrixError,
    ParameterError,
    ScenarioError,
)
"""What is wrong at the door: one line, exit code 2."""

EXIT_CODES = "exit codes: 0 within limits, 1 not, 2 bad input, 3 process lost, 130 interrupted"


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        code: int = arguments.command(arguments)
    except InterruptedRunError as error:
        print(f"hil: {error}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except REFUSALS as error:
        print(f"hil: {error}", file=sys.stderr)
        return EXIT_USAGE
    except BrokenExecutor as error:
        print(f"hil: a worker process was lost: {error}", file=sys.stderr)
        return EXIT_BROKEN
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hil", description="Bench for an integer controller of a hydraulic crane over CAN."
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('ddh-hil')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="play a scenario",
        usage="hil run SCENARIO [options]   (name as in `hil list`, or .toml file)",
        epilog=EXIT_CODES,
        formatter_class=_OneLineEach,
        add_help=False,
    )
    run.add_argument("-h", "--help", action="help", help=argparse.SUPPRESS)
    run.set_defaults(command=_run)
    run.add_argument("scenario", help=argparse.SUPPRESS)
    laws = " ".join(CONTROLLERS)
    run.add_argument("--controller", choices=CONTROLLERS, metavar="LAW", help=f"{laws} (tuning's)")
    add_tuning_arguments(run)
    add_firmware_argument(run)
    run.add_argument("--machine", metavar="K=V,...", help="differing machine: mass=1.5,leak=2 ...")
    run.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND,K=V,...",
        help="what goes wrong (hil list --faults)",
    )
    modes = " ".join(RIGS)
    run.add_argument("--mode", choices=RIGS, default="lockstep", metavar="MODE", help=f"{modes} (the first)")
    run.add_argument("--out", type=Path, metavar="DIR", help="result folder (default out/SCENARIO)")
    run.add_argument("--json", action="store_true", help="print result.json instead of a table")
    run.add_argument("--log", default=".log", metavar="SUFFIX", help="bus log: .log .asc .blf .mf4 ...")
    run.add_argument("--duration", type=float, metavar="S", help="other length than the scenario's, s")
    run.add_argument("-b", "--bitrate", type=int, metavar="B", help="bit/s (default 1000000; -i: adapter's)")
    run.add_argument(
        "--data-bitrate",
        type=int,
        default=DEFAULT_DATA_BIT_RATE,
        metavar="B",
        help="of CAN FD frames (default 5000000)",
    )
    run.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the packaged ddh.dbc")
    run.add_argument("-i", "--interface", metavar="I", help="realtime: interface (default: own bus)")
    run.add_argument("-c", "--channel", metavar="C", help="its channel; lockstep: for listeners")
    run.add_argument(
        "--rt-ratio", type=ratio, default="1", metavar="R", help="realtime: 0.1 is ten times slower"
    )
    run.add_argument(
        "--start-timeout", type=_seconds, default=120.0, metavar="S", help="for processes to start"
    )
    run.add_argument(
        "--answer-timeout", type=_seconds, default=10.0, metavar="S", help="for a node to answer"
    )

    sweep_command.add_command(commands)
    tune_command.add_command(commands)
    faults_command.add_command(commands)

    bus = commands.add_parser("bus", help="serve an embedded bus in wall time")
    bus.set_defaults(command=_bus)
    bus.add_argument("--channel", required=True, help="name to attach to: -i hilbus -c NAME")
    bus.add_argument(
        "--bitrate", type=int, default=DEFAULT_BIT_RATE, metavar="B", help="bit/s (default 1000000)"
    )
    bus.add_argument(
        "--data-bitrate",
        type=int,
        default=DEFAULT_DATA_BIT_RATE,
        metavar="B",
        help="bit/s behind the bit rate switch of CAN FD frames (default 5000000)",
    )
    bus.add_argument("--parent", type=int, help=argparse.SUPPRESS)

    inject_command.add_command(commands)

    vcan = commands.add_parser("vcan", help="SocketCAN on this machine")
    questions = vcan.add_subparsers(required=True, metavar="QUESTION")
    status = questions.add_parser("status", help="say whether SocketCAN is usable; exit code 0 if it is")
    status.set_defaults(command=_vcan_status)

    reproduce.add_command(commands)
    replay_command.add_command(commands)
    rta_command.add_command(commands)
    cost_command.add_command(commands)

    listing = commands.add_parser("list", help="list the built-in scenarios and tunings")
    listing.set_defaults(command=_list)
    listing.add_argument("--faults", action="store_true", help="list the kinds of faults instead")
    return parser


class _OneLineEach(argparse.RawDescriptionHelpFormatter):
    """Help with each option on a line of its own, to fit a screen."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)


def _seconds(text: str) -> float:
    value = float(text)
    if not 1e-3 <= value < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not a time of 0.001 s or more")
    return value


def _run(arguments: argparse.Namespace) -> int:
    scenario = load_scenario(arguments.scenario, arguments.duration)
    if arguments.machine is not None:
        scenario = replace(scenario, machine=scenario.machine.with_text(arguments.machine))
    faults = *scenario.faults, *map(fault_of_text, arguments.fault)
    for fault in faults:
        if complaint := too_late(fault, scenario.duration_s):
            raise FaultError(complaint)
    scenario = replace(scenario, faults=tuple(sorted(faults, key=attrgetter("at_s"))))
    if arguments.mode == "realtime" and (virtual := [f for f in scenario.faults if f.needs_virtual_time]):
        raise BenchError(f"the fault {virtual[0].text} needs virtual time: use --mode inprocess or lockstep")
    if arguments.bitrate is not None:
        check_bit_rate(arguments.bitrate)
    bus = arguments.interface, arguments.channel, arguments.bitrate
    if arguments.mode != "realtime" and arguments.interface is not None:
        raise BenchError(f"--interface needs --mode realtime: {arguments.mode} runs in virtual time")
    if arguments.mode != "realtime" and arguments.rt_ratio != 1:
        raise BenchError("--rt-ratio needs --mode realtime: virtual time has no pace")
    if arguments.interface is not None:
        bus = bus_settings(*bus)
    interface, channel, bit_rate = bus
    stopped = StopFlag.on_signals()
    out = arguments.out or Path("out") / scenario.name
    with OutputDirectory(out, arguments.log) as folder:
        length_s = scenario.duration_s + BRING_UP_S
        with progress_bar(f"{scenario.name}: starting", length_s, "s") as show:
            options = RunOptions(
                scenario=scenario,
                controller=arguments.controller or "",
                tuning=tuning_of(arguments),
                firmware=firmware_of_text(arguments.firmware),
                record_directory=folder.scratch,
                bit_rate=bit_rate,
                data_bit_rate=arguments.data_bitrate,
                dbc=arguments.dbc,
                interface=interface,
                channel=channel,
                rt_ratio=arguments.rt_ratio,
                start_timeout_s=arguments.start_timeout,
                answer_timeout_s=arguments.answer_timeout,
                progress=lambda simulated_s: show(completed=simulated_s, description=scenario.name),
                stopped=stopped,
            )
            with RIGS[arguments.mode](options) as rig:
                recording = play(rig, options)
        trace = trace_of(recording, rig.contract)
        result = result_of(recording, trace, rig.contract, options, rig.mode)
        files = folder.write(result, trace, recording)
    if arguments.json:
        print(json.dumps(result, indent=2))
    else:
        Console().print(_table(result))
        print(f"{', '.join(file.name for file in files)} in {out}")
    if folder.left_out:
        print(
            f"hil: {folder.left_out} CAN FD or error frames are not in the bus log: {arguments.log} has no "
            "room for them, .log, .asc and .blf have",
            file=sys.stderr,
        )
    if scenario.limits and not result["limits"]:
        judged = ", ".join(scenario.limits)
        print(
            f"hil: not judged: {scenario.name} has limits for {judged}, none for {result['controller']}",
            file=sys.stderr,
        )
    if overrun := overrun_of(result):
        print(f"hil: {overrun}", file=sys.stderr)
    if recording.ending or result["verdict"]:
        print(f"hil: {recording.ending or result['verdict']}", file=sys.stderr)
    if recording.broken:
        return EXIT_BROKEN
    if recording.ending == INTERRUPTED:
        return EXIT_INTERRUPTED
    return EXIT_LIMITS if result["within_limits"] is False else EXIT_OK


def _table(result: dict[str, Any]) -> Table:
    table = Table(title=heading(result))
    table.add_column("")
    table.add_column("this run", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("paper", justify="right")
    judged = (result["limits"], result["paper"]) if result["complete"] else (None, None)
    for key in ("rms_mm", "max_mm"):
        limit, paper = ((source or {}).get(key) for source in judged)
        table.add_row(METRICS[key][0], *(_number(value, ".4f") for value in (result[key], limit, paper)))
    latency = result["timing"]["latency_us"]
    rows = (
        (METRICS["chatter_rpm_per_period"][0], _number(result["chatter_rpm_per_period"], ".2f")),
        ("bus load / %", _number(result["bus_load_percent"], ".1f")),
        ("feedback to command, median / µs", _number(latency["p50"], ".0f")),
        ("feedback to command, maximum / µs", _number(latency["max"], ".0f")),
        ("missed periods", str(result["timing"]["missed_periods"])),
        ("late periods", str(result["timing"]["late_periods"])),
        ("injected faults", str(len(result["faults"]))),
        ("start-up / s", _number(result["startup_s"], ".1f")),
        ("times real time", _number(result["realtime_factor"], ".1f")),
    )
    for label, value in rows:
        table.add_row(label, value, "", "")
    return table


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _bus(arguments: argparse.Namespace) -> int:
    check_bit_rate(arguments.bitrate)
    check_data_bit_rate(arguments.data_bitrate, arguments.bitrate)
    wire = Wire(arguments.bitrate, data_bit_rate=arguments.data_bitrate)
    stopped = StopFlag.on_signals()

    def keep_running() -> bool:
        return not (orphaned(arguments.parent) or stopped.is_set())

    with Hub(wire, arguments.channel, expected=None) as hub:
        inject_command.take_faults(hub)
        rates = f"{wire.bit_rate} bit/s, CAN FD data at {wire.data_bit_rate} bit/s"
        print(f"{HUB_GREETING} {arguments.channel!r} at {rates}; Ctrl-C ends it", flush=True)
        hub.run_in_wall_time(keep_running)
        if hub.dropped:
            print(f"hil: {hub.dropped} frames were dropped for slow listeners", file=sys.stderr)
    return EXIT_OK


def _vcan_status(_: argparse.Namespace) -> int:
    status = socketcan_status()
    print(status.line)
    return EXIT_OK if status.usable else EXIT_UNUSABLE


def _list(arguments: argparse.Namespace) -> int:
    if arguments.faults:
        Console().print(_fault_table())
        return EXIT_OK
    table = Table(box=None)
    table.add_column("scenario")
    table.add_column("length / s", justify="right")
    table.add_column("")
    for name in builtin_names():
        scenario = load_scenario(name)
        table.add_row(name, f"{scenario.duration_s:g}", scenario.title)
    Console().print(table)
    tunings = Table(box=None)
    tunings.add_column("tuning")
    tunings.add_column("its control law")
    for name, tuning in TUNINGS.items():
        default = " (default)" if name == DEFAULT_TUNING else ""
        tunings.add_row(f"{name}{default}", controller_of(tuning.law))
    Console().print(tunings)
    return EXIT_OK


def _fault_table() -> Table:
    table = Table(box=None)
    for column in ("fault", "in real time", "parameters, in brackets the default of each"):
        table.add_column(column)
    for row in rows():
        what = f"{row.summary}\n{'; '.join(row.parameters).replace('`', '')}"
        table.add_row(row.kind, "yes" if row.real_time else "", what)
    return table
