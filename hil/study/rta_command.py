"""``hil rta``: worst-case response times of the messages of a DBC file."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from can.util import dlc2len, len2dlc
from rich.console import Console
from rich.table import Table

from dbc.contract import MAX_CLASSIC_DLC, NS_PER_MS, PACKAGED_DBC, ContractError, read_database
from dbc.frame import BRS_FLAG, EFF_FLAG
from hil.bus.wire import DEFAULT_DATA_BIT_RATE
from hil.bus.wire_time import fd_worst_case_bits, worst_case_bits
from hil.run.options import DEFAULT_BIT_RATE, check_bit_rate, check_data_bit_rate
from hil.study.response_time import ResponseTime, Traffic, load, response_times

EXIT_OK, EXIT_MISSED = range(2)
MAX_FD_LENGTH = 64
_VERDICTS = {True: "met", False: "[red]missed[/red]", None: "no deadline"}


def add_command(commands: Any) -> None:
    """Add ``rta`` to the bench's commands."""
    parser = commands.add_parser(
        "rta",
        help="worst-case response time of every message of the DBC",
        description="Worst-case response times (Davis et al. 2007) of the messages of a DBC. "
        "Each node sends its frames by priority; a message with a cycle time is taken to come no oftener, "
        "below one without there is no bound. The bench channel is left out. CAN FD messages switch the bit "
        "rate if CANFD_BRS says so.",
        epilog="exit codes: 0 every message meets its deadline at every bit rate asked for; 1 one does not; "
        "2 wrong input",
    )
    parser.set_defaults(command=_rta)
    parser.add_argument("--dbc", type=Path, default=PACKAGED_DBC, metavar="FILE", help="default: ours")
    parser.add_argument(
        "-b",
        "--bitrate",
        type=int,
        action="append",
        metavar="B",
        help="bit/s (default the DBC's Baudrate); may be repeated",
    )
    parser.add_argument(
        "--data-bitrate",
        type=int,
        metavar="B",
        help="bit/s of CAN FD data (default the DBC's BaudrateCANFD, else 5000000)",
    )
    parser.add_argument(
        "--jitter", type=float, default=0.0, metavar="US", help="queuing jitter of every message, µs"
    )
    parser.add_argument("--json", action="store_true", help="print figures instead of tables")


def traffic_of(dbc: Path, jitter_ns: int = 0) -> tuple[list[Traffic], int, int]:
    """Return the messages of a DBC but those of the bench channel, and its bit rates, that of data last.

    A message without ``GenMsgCycleTime`` has no period.

    Raises
    ------
    ContractError
        If the file is unreadable, has no cyclic message, or one that is no CAN frame.
    """
    database = read_database(dbc)
    traffic = []
    definition = database.dbc.attribute_definitions.get("CANFD_BRS") if database.dbc else None
    switches_by_default = definition.default_value if definition else 0
    for message in database.messages:
        attributes = message.dbc.attributes if message.dbc else {}
        if "BenchChannel" in attributes and attributes["BenchChannel"].value:
            continue
        longest = MAX_FD_LENGTH if message.is_fd else MAX_CLASSIC_DLC
        if message.length > longest:
            raise ContractError(
                f"{dbc}: {message.name} has more than {longest} bytes: no frame, leave it out"
            )
        can_id = message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)
        period_ns = message.cycle_time * NS_PER_MS if message.cycle_time else None
        bits, data_bits = worst_case_bits(can_id, message.length), 0
        if message.is_fd:
            given = attributes["CANFD_BRS"].value if "CANFD_BRS" in attributes else switches_by_default
            flags = BRS_FLAG if str(given) == "1" else 0
            bits, data_bits = fd_worst_case_bits(can_id | flags, dlc2len(len2dlc(message.length)))
        traffic.append(Traffic(message.name, can_id, bits, period_ns, jitter_ns, data_bits=data_bits))
    if not any(message.period_ns for message in traffic):
        raise ContractError(f"{dbc}: no message has a cycle time (GenMsgCycleTime): nothing to bound")
    network = database.dbc.attributes if database.dbc else {}
    nominal, data = (
        int(network[name].value) if name in network else default
        for name, default in (("Baudrate", DEFAULT_BIT_RATE), ("BaudrateCANFD", DEFAULT_DATA_BIT_RATE))
    )
    return traffic, nominal, data


def _rta(arguments: argparse.Namespace) -> int:
    if not 0.0 <= arguments.jitter < 1e6:
        raise ContractError(f"--jitter is {arguments.jitter}, must be from 0 to 1e6 µs")
    traffic, nominal, data_bit_rate = traffic_of(arguments.dbc, round(arguments.jitter * 1e3))
    bit_rates = arguments.bitrate or [nominal]
    if arguments.data_bitrate is not None:
        data_bit_rate = arguments.data_bitrate
    for bit_rate in bit_rates:
        check_bit_rate(bit_rate)
        if any(message.data_bits for message in traffic):
            check_data_bit_rate(data_bit_rate, bit_rate)
    try:
        results = {bit_rate: response_times(traffic, bit_rate, data_bit_rate) for bit_rate in bit_rates}
    except ValueError as error:
        raise ContractError(f"{arguments.dbc}: {error}") from error
    if arguments.json:
        figures = {str(b): _figures(traffic, b, data_bit_rate, rows) for b, rows in results.items()}
        print(json.dumps(figures, indent=2))
    else:
        for bit_rate, rows in results.items():
            Console().print(_table(traffic, bit_rate, data_bit_rate, rows))
    missed = any(row.met is False for rows in results.values() for row in rows)
    return EXIT_MISSED if missed else EXIT_OK


def _figures(
    traffic: list[Traffic], bit_rate: int, data_bit_rate: int, rows: list[ResponseTime]
) -> dict[str, Any]:
    messages = []
    for row in rows:
        figures = asdict(row)
        messages.append(
            {**figures.pop("traffic"), **figures, "deadline_ns": row.traffic.due_ns, "met": row.met}
        )
    load_percent = float(100 * load(traffic, bit_rate, data_bit_rate))
    return {"data_bit_rate": data_bit_rate, "load_percent": load_percent, "messages": messages}


def _table(traffic: list[Traffic], bit_rate: int, data_bit_rate: int, rows: list[ResponseTime]) -> Table:
    share = float(100 * load(traffic, bit_rate, data_bit_rate))
    switched = f", CAN FD data at {data_bit_rate / 1e3:g}" if any(m.data_bits for m in traffic) else ""
    unbounded = "- is no bound" if any(row.worst_ns is None for row in rows) else None
    title = f"{bit_rate / 1e3:g} kbit/s{switched}, load at most {share:.1f} %; times in µs"
    table = Table(title=title, caption=unbounded, box=None)
    for heading in ("message", "id"):
        table.add_column(heading, no_wrap=True)
    for heading in ("period", "frame", "blocked", "worst", "deadline", ""):
        table.add_column(heading, justify="right")
    for row in rows:
        message = row.traffic
        times_ns = message.period_ns, row.duration_ns, row.blocking_ns, row.worst_ns, message.due_ns
        table.add_row(
            message.name,
            f"{message.can_id & ~EFF_FLAG:#x}",
            *("-" if ns is None else f"{ns / 1e3:.0f}" for ns in times_ns),
            _VERDICTS[row.met],
        )
    return table
