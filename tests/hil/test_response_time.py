"""Worst-case response times: the published example, and a wire that never exceeds them."""

import json
from fractions import Fraction

import cantools
import numpy as np
import pytest

import dbc
from dbc.frame import BRS_FLAG, EFF_FLAG, FD_FLAG, Frame
from hil.bus.wire import Wire
from hil.bus.wire_core import LOG_HEAD, LOG_TIME, arbitration_key
from hil.bus.wire_time import (
    FD_LENGTHS,
    INTERMISSION_BITS,
    classic_bits,
    fd_worst_case_bits,
    worst_case_bits,
)
from hil.cli import main
from hil.study.response_time import Traffic, load, response_times
from hil.study.rta_command import traffic_of

BIT_RATE = 125_000
BIT_NS = 8000
DATA_BIT_RATE = 2_000_000
MS = 1_000_000


def message(rank: int, period_ns: int, **other: int) -> Traffic:
    """A frame of 1 ms at 125 kbit/s."""
    return Traffic("ABC"[rank], 0x100 + rank, other.pop("bits", 125), period_ns, **other)


# the published analysis


def test_the_example_that_refuted_the_analysis_of_1994():
    messages = [
        message(0, 2_500_000, deadline_ns=2_500_000),
        message(1, 3_500_000, deadline_ns=3_250_000),
        message(2, 3_500_000, deadline_ns=3_250_000),
    ]
    worst = response_times(messages, BIT_RATE)
    assert [row.worst_ns for row in worst] == [2 * MS, 3 * MS, 3_500_000]
    assert [row.met for row in worst] == [True, True, False]
    assert worst[2].instances == 2, "the second is the worst: the analysis of 1994 saw the first alone"


def test_a_message_alone_takes_its_own_time():
    (row,) = response_times([message(0, 10 * MS, jitter_ns=123)], BIT_RATE)
    assert (row.blocking_ns, row.worst_ns, row.instances) == (0, MS + 123, 1)


def test_the_lowest_priority_is_not_blocked():
    *_, lowest = response_times([message(0, 10 * MS), message(1, 10 * MS)], BIT_RATE)
    assert (lowest.blocking_ns, lowest.worst_ns) == (0, 2 * MS)


def test_a_frame_that_arrives_within_the_first_bit_still_wins():
    high, low = message(0, MS + BIT_NS // 2), message(1, 1000 * MS)
    assert response_times([high, low], BIT_RATE)[1].worst_ns == 3 * MS, "the second instance of A comes first"


def test_there_is_no_bound_from_an_overloaded_priority_on():
    rows = response_times([message(0, 2 * MS), message(1, 2 * MS), message(2, 100 * MS)], BIT_RATE)
    assert [row.worst_ns for row in rows] == [2 * MS, None, None]
    assert not rows[1].met


def test_a_message_that_may_come_at_any_time_blocks_those_above_it_and_leaves_no_bound_below_it():
    above, whenever, below = response_times(
        [message(0, 10 * MS), message(1, None), message(2, 10 * MS)], BIT_RATE
    )
    assert (above.blocking_ns, above.worst_ns, above.met) == (MS, 2 * MS, True)
    assert (whenever.worst_ns, whenever.met) == (None, None)
    assert (below.worst_ns, below.met) == (None, False)


def test_priorities_are_those_of_arbitration():
    standard, extended = Traffic("S", 0x100, 125, 10 * MS), Traffic("E", EFF_FLAG | 0x100 << 18, 125, 10 * MS)
    assert [row.traffic.name for row in response_times([extended, standard], BIT_RATE)] == ["S", "E"]


@pytest.mark.parametrize(
    ("messages", "said"),
    [
        ([message(0, MS), Traffic("twin", 0x100, 125, MS)], "A and twin have one identifier 0x100"),
        ([message(0, 0)], "A has a period of 0 ns, must be positive"),
    ],
)
def test_what_cannot_be_analysed_is_refused(messages, said):
    with pytest.raises(ValueError, match=said):
        response_times(messages, BIT_RATE)


@pytest.mark.parametrize("dlc", range(9))
def test_the_longest_frame_is_that_of_the_literature(dlc):
    assert worst_case_bits(0x123, dlc) == 55 + 10 * dlc
    assert worst_case_bits(EFF_FLAG | 0x123, dlc) == 80 + 10 * dlc


def most_stuff_bits(can_id: int, length: int) -> int:
    """Return the most stuff bits of a CAN FD frame up to the end of its data, whatever its free bits are."""
    switched = 1 if can_id & BRS_FLAG else 0
    if can_id & EFF_FLAG:
        head = f"0{can_id >> 18 & 0x7FF:011b}11{can_id & 0x3FFFF:018b}010{switched}"
    else:
        head = f"0{can_id & 0x7FF:011b}0010{switched}"
    bits = head + "?" + f"{FD_LENGTHS.tolist().index(length):04b}" + "?" * (8 * length)  # ? ESI, data
    most = {(0, "1"): 0}  # by length and level of the run of equal bits
    for place, bit in enumerate(bits):
        following: dict[tuple[int, str], int] = {}
        for (run, level), count in most.items():
            for now in "01" if bit == "?" else bit:
                state, more = (run + 1 if now == level else 1, now), 0
                if state[0] == 5 and place < len(bits) - 1:
                    state, more = (1, "10"[int(now)]), 1
                following[state] = max(following.get(state, 0), count + more)
        most = following
    return max(most.values())


@pytest.mark.parametrize("length", FD_LENGTHS.tolist())
@pytest.mark.parametrize("flags", [0, BRS_FLAG, EFF_FLAG, EFF_FLAG | BRS_FLAG])
def test_the_longest_fd_frame_is_the_longest_of_all_there_are(flags, length):
    rng = np.random.default_rng(11898)
    without_stuff_bits = (36 if flags & EFF_FLAG else 17) + 5 + 8 * length + (27 if length <= 16 else 32) + 13
    for base in (0, 0x7FF, *rng.integers(0x7FF, size=10).tolist()):
        can_id = flags | (base << 18 | int(rng.integers(1 << 18)) if flags & EFF_FLAG else base)
        nominal, fast = fd_worst_case_bits(can_id, length)
        assert nominal + fast == without_stuff_bits + most_stuff_bits(can_id, length)
        assert bool(fast) == bool(flags & BRS_FLAG)


# the wire against the analysis


def random_set(rng: np.random.Generator, fd: bool = False) -> tuple[int, list[tuple[Traffic, Frame]]]:
    """Return a bit rate and messages with a bound, each with the frame it always sends."""
    bit_rate = int(rng.choice([125_000, 250_000, 500_000, 1_000_000]))
    ids = rng.choice(0x7FF, size=int(rng.integers(2, 9)), replace=False).tolist()
    share = rng.uniform(0.2, 0.98)
    messages = []
    for number, base in enumerate(ids):
        can_id = EFF_FLAG | base << 18 | int(rng.integers(1 << 18)) if rng.random() < 0.3 else base
        switched = BRS_FLAG if rng.random() < 0.7 else 0
        flags = FD_FLAG | switched if fd and rng.random() < 0.6 else 0
        dlc = int(rng.choice(FD_LENGTHS)) if flags else int(rng.integers(9))
        ones = (1 << 8 * dlc) - 1
        data = (0, ones, int.from_bytes(rng.bytes(64)) & ones)[int(rng.integers(3))]
        bits, data_bits = (
            fd_worst_case_bits(can_id | flags, dlc) if flags else (worst_case_bits(can_id, dlc), 0)
        )
        longest_ns = bits * 1e9 / bit_rate + data_bits * 1e9 / DATA_BIT_RATE
        period_ns = round(longest_ns * len(ids) / share * rng.uniform(0.5, 1.5))
        jitter_ns = int(rng.integers(period_ns // 2)) if rng.random() < 0.5 else 0
        traffic = Traffic(f"m{number}", can_id, bits, period_ns, jitter_ns, data_bits=data_bits)
        messages.append((traffic, Frame(can_id | flags, dlc, data)))
    return bit_rate, messages


def responses_ns(bit_rate: int, sent: list[tuple[int, int, Frame]], begin_ns: int = 0) -> dict[int, int]:
    """Return the longest response by identifier, of frames with their event's and their ready time.

    A response ends with the frame's intermission, as in the analysis.
    """
    wire = Wire(bit_rate, data_bit_rate=DATA_BIT_RATE)
    for sender, (_, ready_ns, frame) in enumerate(sent):
        wire.send(1000 + sender, ready_ns, frame)
    wire.run(1 << 61)
    events: dict[int, list[int]] = {}
    for event_ns, ready_ns, frame in sorted(sent, key=lambda entry: entry[1]):
        events.setdefault(frame.can_id & 0xFFFF_FFFF, []).append(event_ns)
        assert ready_ns >= event_ns
    longest: dict[int, int] = {}
    assert len(wire.log) == len(sent)
    for row in wire.log.tolist():
        can_id = row[LOG_HEAD] & 0xFFFF_FFFF
        end_ns = row[LOG_TIME] + INTERMISSION_BITS * 10**9 // bit_rate
        longest[can_id] = max(longest.get(can_id, 0), end_ns - events[can_id].pop(0))
    return longest


@pytest.mark.parametrize("fd", [False, True])
def test_no_frame_on_the_wire_takes_longer_than_its_bound(fd):
    rng = np.random.default_rng(2007)
    tight = 0
    for _ in range(1000):
        bit_rate, messages = random_set(rng, fd)
        sent = []
        horizon_ns = 12 * max(traffic.period_ns for traffic, _ in messages)
        for traffic, frame in messages:
            offset_ns = int(rng.integers(traffic.period_ns)) if rng.random() < 0.5 else 0
            for event_ns in range(offset_ns, horizon_ns, traffic.period_ns)[:40]:
                late_ns = int(rng.integers(traffic.jitter_ns + 1))
                sent.append((event_ns, event_ns + late_ns, frame))
        longest = responses_ns(bit_rate, sent)
        for row in response_times([traffic for traffic, _ in messages], bit_rate, DATA_BIT_RATE):
            if row.worst_ns is None:
                continue
            seen_ns = longest[row.traffic.can_id]
            assert seen_ns <= row.worst_ns, (row, seen_ns)
            tight += seen_ns > 0.8 * row.worst_ns
    assert tight > 500, "the bound must not hold for want of traffic"


def test_the_wire_meets_the_analysis_at_the_critical_instant():
    """All above a message are ready with it, and the longest below it has just begun.

    The analysis lets a frame win that comes within the first bit of another; the wire decides at its start.
    So where a frame comes there, and only there, the wire is faster by more than the few bits.
    """
    rng = np.random.default_rng(1994)
    met = exceptions = several = 0
    for _ in range(200):
        bit_rate, messages = random_set(rng)
        few_bits_ns = 2 * 10**9 // bit_rate
        actual = [
            (Traffic(t.name, t.can_id, classic_bits(*frame), t.period_ns), frame) for t, frame in messages
        ]
        actual.sort(key=lambda entry: arbitration_key(entry[0].can_id))
        for rank, row in enumerate(response_times([traffic for traffic, _ in actual], bit_rate)):
            if row.worst_ns is None:
                continue
            below = [(0, 0, frame) for _, frame in actual[rank + 1 :]]
            sent = [max(below, key=lambda entry: classic_bits(*entry[2]))] if below else []
            until_ns = 1 + row.instances * row.traffic.period_ns
            for traffic, frame in actual[: rank + 1]:
                sent += [(at_ns, at_ns, frame) for at_ns in range(1, until_ns, traffic.period_ns)]
            seen_ns = responses_ns(bit_rate, sent)[row.traffic.can_id]
            assert seen_ns <= row.worst_ns
            met += seen_ns >= row.worst_ns - few_bits_ns
            exceptions += seen_ns < row.worst_ns - few_bits_ns
            several += row.instances > 1
    assert met > 500
    assert several > 20
    assert exceptions < 0.02 * met, (exceptions, met)


# the DBC and the command


def test_the_messages_are_those_of_the_dbc_with_a_cycle_time():
    traffic, bit_rate, _ = traffic_of(dbc.contract.PACKAGED_DBC)
    database = cantools.database.load_file(dbc.contract.PACKAGED_DBC)
    assert {t.name: t.period_ns for t in traffic} == {
        m.name: m.cycle_time * MS for m in database.messages if m.cycle_time
    }
    assert bit_rate == 1_000_000
    assert load(traffic, 500_000) < Fraction(85, 100)


def test_the_command_prints_a_verdict_for_every_message(capsys):
    assert main(["rta", "-b", "1000000", "-b", "500000"]) == 0
    said = capsys.readouterr().out
    assert said.count("met") == 2 * 8
    assert "1000 kbit/s" in said
    assert "500 kbit/s" in said


@pytest.mark.parametrize(("bit_rate", "met"), [(125_000, 0), (250_000, 1), (500_000, 8), (1_000_000, 8)])
def test_at_every_usual_bit_rate_each_message_is_met_or_missed(capsys, bit_rate, met):
    assert main(["rta", "-b", str(bit_rate)]) == (met < 8), "a missed deadline is an exit code"
    verdicts = [line.split()[-1] for line in capsys.readouterr().out.splitlines() if " 0x" in line]
    assert verdicts == ["met"] * met + ["missed"] * (8 - met)


def test_the_figures_can_be_had_as_json(capsys):
    assert main(["rta", "-b", "1000000", "--jitter", "100", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["1000000"]
    first = figures["messages"][0]
    assert (first["name"], first["jitter_ns"], first["met"]) == ("DriveCommand", 100_000, True)
    assert first["worst_ns"] == 100_000 + 135_000 + 115_000, "jitter, the longest frame below it, its own"
    assert 0 < figures["load_percent"] < 50


FD_DBC = """VERSION ""
BU_: N
BO_ 256 switched: 64 N

BO_ 257 not_switched: 64 N

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","StandardCAN_FD";
BA_DEF_ BO_ "CANFD_BRS" ENUM "0","1";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ "BaudrateCANFD" INT 0 16000000;
BA_DEF_DEF_ "GenMsgCycleTime" 10;
BA_DEF_DEF_ "CANFD_BRS" "1";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";
BA_ "BaudrateCANFD" 4000000;
BA_ "CANFD_BRS" BO_ 257 0;
"""


def test_can_fd_messages_are_analysed_at_both_bit_rates(capsys, tmp_path):
    path = tmp_path / "fd.dbc"
    path.write_text(FD_DBC)
    assert main(["rta", "--dbc", str(path), "-b", "500000", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["500000"]
    nominal, fast = fd_worst_case_bits(0x100 | BRS_FLAG, 64)
    all_nominal, _ = fd_worst_case_bits(0x101, 64)
    ends_ns = [nominal * 2000 + fast * 250 + all_nominal * 2000] * 2
    assert [message["worst_ns"] for message in figures["messages"]] == ends_ns
    assert figures["data_bit_rate"] == 4_000_000
    assert main(["rta", "--dbc", str(path), "--data-bitrate", "8000000"]) == 0
    assert "CAN FD data at 8000" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-b", "1"], "bit rate 1 is not from"),
        (["--dbc", "nowhere.dbc"], "nowhere.dbc: cannot be read"),
        (["--dbc", "twins.dbc"], "twins.dbc: one and other have one identifier 0x100"),
        (["--dbc", "stopped.dbc"], "bit rate 0 is not from"),
        (["--dbc", "long.dbc"], "long.dbc: one has more than 8 bytes: no frame, leave it out"),
        (["--dbc", "fd.dbc", "--data-bitrate", "9"], "CAN FD data bit rate 9 is not from 1000000"),
        (["--jitter", "-1"], "--jitter is -1.0, must be from 0"),
    ],
)
def test_wrong_input_is_refused_with_one_line(capsys, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_DEF_DEF_ "GenMsgCycleTime" 10;\n'
    frames = "".join(f"BO_ {number} {name}: 8 N\n\n" for name, number in (("one", 256), ("other", 256)))
    (tmp_path / "twins.dbc").write_text(f'VERSION ""\nBU_: N\n{frames}{cycle}')
    stopped = 'BA_DEF_ "Baudrate" INT 0 1000000;\nBA_DEF_DEF_ "Baudrate" 0;\nBA_ "Baudrate" 0;\n'
    (tmp_path / "stopped.dbc").write_text(f'VERSION ""\nBU_: N\nBO_ 256 one: 8 N\n\n{cycle}{stopped}')
    (tmp_path / "long.dbc").write_text(f'VERSION ""\nBU_: N\nBO_ 256 one: 64 N\n\n{cycle}')
    (tmp_path / "fd.dbc").write_text(FD_DBC)
    assert main(["rta", *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
