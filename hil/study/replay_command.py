"""``hil replay``: the command line of replaying a bus log to the firmware."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from dbc.contract import Contract
from firmware_py.chosen_firmware import add_firmware_argument, firmware_of_text
from firmware_py.chosen_tuning import add_tuning_arguments, tuning_of
from hil.picture import BLUE, GREY, ORANGE, RED
from hil.report import ResultFolder
from hil.run.options import BenchError, check_bit_rate
from hil.scenario import CONTROLLERS, law_of
from hil.signals import decoded, signal_of

if TYPE_CHECKING:
    from hil.bus_log import BusLog
    from hil.study.replay import Difference, Replay

EXIT_EQUAL, EXIT_NOT_EQUAL = range(2)
COUNTS = {
    "recorded": "in the log",
    "computed": "computed",
    "equal": "equal",
    "lost_on_the_bus": "lost on the bus",
    "only_computed": "only computed",
    "only_recorded": "only in the log",
}
EXIT_CODES = """exit codes: 0 all that is in the log is computed again; 1 something differs, or
the log ends early; 2 wrong input"""


def add_command(commands: Any) -> None:
    """Add ``hil replay`` to the command line."""
    replay = commands.add_parser(
        "replay",
        help="feed a bus log to the firmware and compare what it sends",
        usage="hil replay LOG [options]   (.log .asc .blf .mf4 ..., also .gz)",
        epilog=EXIT_CODES,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=40),
    )
    replay.set_defaults(command=_replay)
    replay.add_argument("log", type=Path, help=argparse.SUPPRESS)
    laws = ", ".join(CONTROLLERS)
    replay.add_argument(
        "--controller", choices=CONTROLLERS, metavar="LAW", help=f"{laws} (default: the log's)"
    )
    add_tuning_arguments(replay)
    add_firmware_argument(replay)
    replay.add_argument("--dbc", type=Path, metavar="FILE", help="another DBC than the packaged ddh.dbc")
    replay.add_argument("-c", "--channel", metavar="C", help="of a log that has more than one")
    replay.add_argument("-b", "--bitrate", type=int, metavar="B", help="bit/s (default: the DBC's)")
    replay.add_argument("--out", type=Path, metavar="DIR", help="folder for replay.json and replay.png")
    replay.add_argument("--json", action="store_true", help="print replay.json instead of a table")


def _replay(arguments: argparse.Namespace) -> int:
    from hil.bus_log import read_bus_log
    from hil.study.replay import replay  # compiles the kernel when it has changed

    tuning = tuning_of(arguments)
    contract = Contract.load(arguments.dbc)
    bit_rate = arguments.bitrate if arguments.bitrate is not None else contract.bitrate
    check_bit_rate(bit_rate)
    firmware = firmware_of_text(arguments.firmware)
    law = None if arguments.controller is None else law_of(arguments.controller)
    with Console(stderr=True).status(f"reading {arguments.log}") as status:
        log = read_bus_log(arguments.log, arguments.channel)
        damage = log.damage or _missing_of_run(arguments.log, log)

        def advance(share: float) -> None:
            status.update(f"replaying {arguments.log}: {share:.0%}")

        try:
            replayed = replay(log.traffic, contract, tuning.calibration, bit_rate, law, firmware, advance)
        except BenchError as error:
            raise BenchError(f"{arguments.log}: {error}") from error
    result = {
        "log": str(arguments.log),
        "tuning": tuning.name,
        "controller": arguments.controller,
        "firmware": firmware.text,
        **figures_of(replayed, contract),
        "log_end_s": int(log.traffic[-1, 0]) / 1e9,
        "log_damage": damage,
        "passed_over": {"error": replayed.error_frames, **log.left_out},
    }
    files = [] if arguments.out is None else _write(arguments.out, result, replayed, contract)
    if arguments.json:
        print(json.dumps(result, indent=2))
    else:
        _print(result)
        if files:
            print(f"{' and '.join(file.name for file in files)} in {arguments.out}")
    for line in _reservations(result):
        print(f"hil: {line}", file=sys.stderr)
    return EXIT_NOT_EQUAL if result["differences"] or damage else EXIT_EQUAL


def _missing_of_run(path: Path, log: "BusLog") -> str:
    """Return that a run counted more frames than its log holds, if its result lies beside the log."""
    from hil.bus_log import holds_all_frames

    frames = len(log.traffic) + log.left_out.total()
    try:
        counted = json.loads(path.with_name("result.json").read_text(encoding="utf-8"))["bus_frames"]
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    is_short = path.stem == "bus" and holds_all_frames(path) and frames < counted
    return f"{frames} frames, {counted} in result.json" if is_short else ""


def figures_of(replayed: "Replay", contract: Contract) -> dict[str, Any]:
    """Return what came of a replay, as written to ``replay.json``; times are those of the log."""
    differences = replayed.differences
    return {
        "reset_s": replayed.begin_ns / 1e9,
        "timer": {"phase_us": replayed.phase.phase_ns / 1e3, "inferred": not replayed.phase.exact},
        "periods": {
            "replayed": len(replayed.timers_ns),
            "compared": replayed.compared_periods,
            "equal": replayed.equal_periods,
            "unsure": len(replayed.unsure_ns),
        },
        "messages": {
            message.name: {
                "recorded": len(message.recorded),
                "computed": len(message.computed),
                "equal": int(message.is_equal.sum()),
                "lost_on_the_bus": len(message.lost),
                "only_computed": len(message.missing),
                "only_recorded": int((message.partner < 0).sum()),
                "first_difference": next(
                    (_shown(difference, replayed, contract) for difference in message.differences), None
                ),
            }
            for message in replayed.messages
        },
        "differences": len(differences),
        "first_difference": _shown(differences[0], replayed, contract) if differences else None,
    }


def _shown(difference: "Difference", replayed: "Replay", contract: Contract) -> dict[str, Any]:
    message = contract.message(difference.message)
    shown: dict[str, Any] = {
        "message": difference.message,
        "time_s": difference.time_ns / 1e9,
        "since_reset_s": (difference.time_ns - replayed.begin_ns) / 1e9,
    }
    for side, frame in (("recorded", difference.recorded), ("computed", difference.computed)):
        shown[side] = frame and {
            "data": frame.data.to_bytes(8, "little")[: frame.dlc].hex(" "),
            "signals": decoded(message, frame.data),
        }
    return shown


def _print(result: dict[str, Any]) -> None:
    table = Table(title=f"{result['log']} replayed under {_under(result)}", box=None)
    table.add_column("message", no_wrap=True)
    for heading in COUNTS.values():
        table.add_column(heading, justify="right")
    for name, message in result["messages"].items():
        table.add_row(name, *(str(message[key]) for key in COUNTS))
    console, periods = Console(), result["periods"]
    console.print(table)
    span = f"from {result['reset_s']:.6f} s to {result['log_end_s']:.6f} s"
    print(f"{periods['equal']} of {periods['compared']} control periods equal, {span}")
    firsts = [message["first_difference"] for message in result["messages"].values()]
    for first in sorted(filter(None, firsts), key=lambda first: first["time_s"]):
        where = f"{first['time_s']:.6f} s ({first['since_reset_s']:.6f} s after the reset)"
        print(f"\nfirst difference of {first['message']}: {where}")
        console.print(_beside(first["recorded"], first["computed"]))


def _under(result: dict[str, Any]) -> str:
    """Return what the log was replayed under: tuning, control law and firmware."""
    return f"{result['tuning']} ({result['controller'] or 'the law of the log'}), {result['firmware']}"


def _beside(recorded: dict[str, Any] | None, computed: dict[str, Any] | None) -> Table:
    """Return what differs in two frames of a message; of one alone, its data."""
    table = Table(box=None, padding=(0, 2))
    for heading in ("", "recorded", "computed"):
        table.add_column(heading, no_wrap=True)
    rows = [_cells(frame) for frame in (recorded, computed)]
    for name in rows[0] | rows[1] if recorded and computed else ("data",):
        ours, theirs = (cells.get(name, "-") for cells in rows)
        if ours != theirs:
            table.add_row(name, ours, theirs)
    return table


def _cells(frame: dict[str, Any] | None) -> dict[str, str]:
    return {"data": frame["data"], **frame["signals"]} if frame else {}


def _reservations(result: dict[str, Any]) -> list[str]:
    """Return what the reader has to know beside the figures, a line each."""
    lines = []
    if damage := result["log_damage"]:
        lines.append(
            f"{result['log']} ends early or is damaged ({damage}): compared up to {result['log_end_s']:.6f} s"
        )
    if result["timer"]["inferred"]:
        lines.append(
            "not on a simulated bus's time: the timer's phase is inferred from the commands, and what a "
            "stall kept from the recorded firmware is not in the log"
        )
    if unsure := result["periods"]["unsure"]:
        lines.append(
            f"in {unsure} periods a frame ended as the timer fired: the log cannot tell which was first"
        )
    if passed := {kind: count for kind, count in result["passed_over"].items() if count}:
        what = ", ".join(f"{count} {kind}" for kind, count in passed.items())
        lines.append(f"passed over, as no node takes them: {what} frames")
    return lines


def _write(out: Path, result: dict[str, Any], replayed: "Replay", contract: Contract) -> list[Path]:
    with ResultFolder(out) as folder:
        made = [folder.scratch / "replay.json", folder.scratch / "replay.png"]
        made[0].write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        draw(made[1], result, replayed, contract)
        return folder.move_in(made)


def draw(path: Path, result: dict[str, Any], replayed: "Replay", contract: Contract) -> None:
    """Draw the target velocity recorded and computed, and where they part."""
    import matplotlib  # 0.3 s, which only drawing should cost

    matplotlib.use("Agg")
    from matplotlib import pyplot

    command = replayed.messages[0]
    recorded, computed = (
        signal_of(traffic, contract, "DriveCommand.TargetVelocity", replayed.begin_ns)
        for traffic in (command.recorded, command.computed)
    )
    paired = command.partner >= 0
    apart_rpm = recorded.values[paired] - computed.values[command.partner[paired]]
    figure, axes = pyplot.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    velocity, difference = axes
    periods = result["periods"]
    figure.suptitle(
        f"{result['log']} under {_under(result)}\n"
        f"{periods['equal']} of {periods['compared']} control periods equal"
    )
    velocity.plot(recorded.time_s, recorded.values, color=GREY, lw=3, label="recorded")
    velocity.plot(computed.time_s, computed.values, color=BLUE, lw=1.2, label="computed")
    velocity.set_ylabel("target velocity / rpm")
    difference.plot(recorded.time_s[paired], apart_rpm, color=ORANGE, lw=0.9, label="recorded - computed")
    difference.set_ylabel("difference / rpm")
    difference.set_xlabel("time since the reset / s")
    for axis in axes:
        if first := result["messages"][command.name]["first_difference"]:
            axis.axvline(first["since_reset_s"], color=RED, lw=0.9, ls="--", label="first difference")
        axis.grid(alpha=0.3)
        axis.legend(loc="best", fontsize="small")
        axis.margins(x=0.01)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
