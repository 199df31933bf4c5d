"""Timing of each control period: known charts, a slow loop as oracle, the bench itself, limits in words."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bench_runs import played
from bit_by_bit import reference_bits
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.contract import Contract
from firmware_py.node import EXECUTION_NS
from hil import cli
from hil.measure import overrun_of, result_of, timing_in
from hil.run.options import Recording, RunOptions
from hil.scenario import ScenarioError, TimingLimits, load_scenario
from hil.signals import NothingKnownError
from hil.timing import INFERRED, RECORDED, Timing, timing_of

CONTRACT = Contract.load()
FEEDBACK, SETPOINT, COMMAND = (
    message.can_id
    for message in (CONTRACT.position_feedback, CONTRACT.position_setpoint, CONTRACT.drive_command)
)
PERIOD_NS = 1_000_000
BIT_RATE = 1_000_000
START_NS = 100 * PERIOD_NS
END_OF = {FEEDBACK: 100_000, SETPOINT: 200_000, COMMAND: 700_000}
"""When the frames of a period end on the hand-made chart, after its start, ns."""

TIMER_NS = 500_000
FIGURES = ("feedback_age_us", "setpoint_age_us", "latency_us", "jitter_us")
COUNTS = ("missed_periods", "late_periods")


# a hand-made chart: ten periods from bus time 0.1 s on, counters as the period's number


def chart(periods: int = 10, without=(), ends_ns=None) -> np.ndarray:
    """Rows of traffic, from two periods before the window on.

    `without` are (id, period) to leave out, `ends_ns` other ends of (id, period), counted from that period.
    """
    rows = [
        (START_NS + k * PERIOD_NS + (ends_ns or {}).get((can_id, k), end_ns), can_id, 6, (k & 15) << 8)
        for k in range(-2, periods)
        for can_id, end_ns in END_OF.items()
        if (can_id, k) not in without
    ]
    return np.array(sorted(rows), dtype=np.uint64)


def timers(periods: int = 10) -> np.ndarray:
    return START_NS + np.arange(-2, periods) * PERIOD_NS + TIMER_NS


def timing(traffic: np.ndarray, periods: int = 10, timer_ns: np.ndarray | None = None) -> Timing:
    return timing_of(
        traffic,
        CONTRACT,
        BIT_RATE,
        START_NS,
        START_NS + periods * PERIOD_NS,
        timers(periods) if timer_ns is None else timer_ns,
    )


def test_the_figures_of_an_even_chart():
    even = timing(chart())
    assert even.feedback_age_us.values.tolist() == [400.0] * 10
    assert even.setpoint_age_us.values.tolist() == [300.0] * 10
    assert even.latency_us.values.tolist() == [600.0] * 10
    assert even.jitter_us.values.tolist() == [0.0] * 10
    assert all(getattr(even, name).period.tolist() == list(range(10)) for name in FIGURES)
    assert (len(even.missed_periods), len(even.late_periods)) == (0, 0)
    assert even.longest_gap_us == 1000.0
    assert even.timer == RECORDED


def test_median_99th_percentile_and_maximum_in_the_summary():
    ends_ns = {(FEEDBACK, k): 100_000 + k * 1000 for k in range(101)}
    ages = timing(chart(101, ends_ns=ends_ns), 101).feedback_age_us
    assert (ages.p50, ages.p99, ages.max) == (350.0, 399.0, 400.0)
    assert ages.summary() == {"p50": 350.0, "p99": 399.0, "max": 400.0}


def test_a_missing_feedback_ages_the_one_before_and_the_command_made_from_it():
    one = timing(chart(without=[(FEEDBACK, 4)]))
    assert one.feedback_age_us.values.tolist() == [400.0] * 4 + [1400.0] + [400.0] * 5
    assert one.latency_us.values.tolist() == [600.0] * 4 + [1600.0] + [600.0] * 5
    assert one.setpoint_age_us.max == 300.0


def test_an_input_that_ends_when_the_timer_fires_is_seen_by_it():
    at, after = ({(SETPOINT, 4): TIMER_NS}, {(SETPOINT, 4): TIMER_NS + 1})
    assert timing(chart(ends_ns=at)).setpoint_age_us.values[4] == 0.0
    assert timing(chart(ends_ns=after)).setpoint_age_us.values[4] == 1300.0


def test_a_command_that_never_ended_is_a_missed_period():
    one = timing(chart(without=[(COMMAND, 4)]))
    assert one.missed_periods.period.tolist() == [4]
    assert len(one.late_periods) == 0
    assert one.longest_gap_us == 2000.0
    assert one.jitter_us.period.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert one.jitter_us.values.tolist() == [0.0] * 4 + [1000.0] + [0.0] * 4
    assert one.latency_us.period.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert one.latency_us.max == 600.0


@pytest.mark.parametrize("late_ns", [1, 20_000, 599_999, 600_000, 650_000])
def test_a_command_after_the_latch_is_late_however_late(late_ns):
    one = timing(chart(ends_ns={(COMMAND, 4): PERIOD_NS + late_ns}))
    assert one.late_periods.period.tolist() == [4]
    assert one.missed_periods.period.tolist() == [4]
    assert one.latency_us.values.tolist() == [600.0] * 4 + [900.0 + late_ns / 1e3] + [600.0] * 5


def test_a_command_that_ends_with_the_latch_is_in_time_as_the_drive_sees_it():
    one = timing(chart(ends_ns={(COMMAND, 4): PERIOD_NS}))
    assert (len(one.late_periods), len(one.missed_periods)) == (0, 0)
    assert one.jitter_us.values[4] == 300.0


def test_commands_held_up_together_each_belong_to_their_own_timer():
    """A busy bus keeps those of 3, 4 and 5 back: they end shortly before that of 6."""
    held = {(COMMAND, 3 + n): (3 - n) * PERIOD_NS + 300_000 + n * 110_000 for n in range(3)}
    one = timing(chart(ends_ns=held | {(COMMAND, 6): 700_000}))
    assert one.late_periods.period.tolist() == [3, 4, 5]
    assert one.missed_periods.period.tolist() == [3, 4, 5]
    assert one.latency_us.period.tolist() == list(range(10))
    assert one.latency_us.values.tolist() == [600.0] * 3 + [3200.0, 2310.0, 1420.0] + [600.0] * 4


def test_an_extra_command_moves_no_other():
    extra = [START_NS + 5 * PERIOD_NS + 10_000, COMMAND, 6, 0]
    rows = sorted([*chart().tolist(), extra])
    one = timing(np.array(rows, np.uint64))
    assert (len(one.late_periods), len(one.missed_periods)) == (0, 0)
    assert sorted(one.latency_us.values.tolist()) == [600.0] * 10 + [910.0]
    assert one.latency_us.period.tolist().count(4) == 2


def test_only_whole_periods_of_the_window_count():
    before = {(FEEDBACK, -1): 400_000, (COMMAND, -1): 950_000}
    one = timing(chart(ends_ns=before))
    assert one.periods == 10
    assert one.feedback_age_us.max == 400.0
    assert one.jitter_us.values[0] == 250.0, (
        "the command before the window is where its first interval begins"
    )
    shifted = timing_of(chart(), CONTRACT, BIT_RATE, START_NS + 1, START_NS + 5 * PERIOD_NS - 1, timers())
    assert shifted.periods == 3


def test_a_controller_that_stops_midway_has_missed_all_the_rest():
    silent = [(COMMAND, k) for k in range(5, 10)]
    stopped = timing(chart(without=silent), timer_ns=timers(5))
    assert stopped.missed_periods.period.tolist() == [5, 6, 7, 8, 9]
    assert stopped.feedback_age_us.period.tolist() == [0, 1, 2, 3, 4]
    assert stopped.longest_gap_us == 5300.0, "up to the end of the window"


def test_the_first_period_without_feedback_is_unknown_not_good():
    nothing_yet = [(FEEDBACK, k) for k in (-2, -1, 0)]
    one = timing(chart(without=nothing_yet))
    assert np.isnan(one.feedback_age_us.values[0])
    assert np.isnan(one.latency_us.values[0])
    assert one.feedback_age_us.max == 400.0
    assert [str(broken) for broken in one.violations(TimingLimits(feedback_age_us=500))] == [
        "period 0 (0.000 s): feedback age is unknown, limit 500 µs: no PositionFeedback so far, "
        "controller timer at bus time 0.100500 s"
    ]


@pytest.mark.parametrize("timer_ns", [None, np.empty(0), timers()], ids=["inferred", "none", "recorded"])
@pytest.mark.parametrize("of_others", [0, 5], ids=["empty", "of others"])
def test_traffic_without_any_of_the_three_messages(timer_ns, of_others):
    traffic = np.array([(START_NS + k, 0x700, 0, 0) for k in range(of_others)], np.uint64).reshape(-1, 4)
    one = timing_of(traffic, CONTRACT, BIT_RATE, START_NS, START_NS + 10 * PERIOD_NS, timer_ns)
    assert len(one.missed_periods) == 10
    assert one.longest_gap_us == 10_000.0
    summary = one.summary()
    assert summary["latency_us"] == {"p50": None, "p99": None, "max": None}
    json.dumps(summary, allow_nan=False)
    with pytest.raises(NothingKnownError, match="nothing was measured in"):
        _ = one.latency_us.max
    broken = one.violations(TimingLimits(latency_us=1e9))
    assert [str(line) for line in broken] == [
        "period 0 (0.000 s): latency is unknown, limit 1e+09 µs: none in all 10 periods"
    ]


def test_a_window_without_periods_has_nothing_to_judge():
    one = timing_of(chart(), CONTRACT, BIT_RATE, START_NS, START_NS - PERIOD_NS, timers())
    assert one.violations(TimingLimits(0, 0, 0, 0, 0, 0)) == []
    assert one.summary()["longest_gap_us"] is None


def test_a_single_command_has_no_interval():
    traffic = np.array([(START_NS + 700_000, COMMAND, 6, 0)], np.uint64)
    assert timing(traffic).jitter_us.values.size == 0


# any traffic: a slow loop over the definitions


@st.composite
def any_traffic(draw):
    """Frames of four ids, timers and a window anywhere in six periods, on a grid that makes ties."""
    grid_ns = draw(st.sampled_from([100_000, 50_000, 1]))
    instants = st.integers(0, 6 * PERIOD_NS // grid_ns).map(lambda n: n * grid_ns)
    data = st.integers(0, 2**48 - 1)
    frame = st.tuples(instants, st.sampled_from([FEEDBACK, SETPOINT, COMMAND, 0x700]), st.just(6), data)
    frames = draw(st.lists(frame, min_size=draw(st.sampled_from([0, 15])), max_size=60))
    timer_ns = draw(st.none() | st.lists(instants, unique=True, max_size=15))
    start_ns = draw(st.integers(0, 3)) * PERIOD_NS + draw(st.sampled_from([0, 0, 1]))
    end_ns = draw(instants)
    return sorted(frames), timer_ns, start_ns, end_ns


@given(any_traffic())
@settings(max_examples=500, deadline=None)
def test_any_traffic_gives_what_a_slow_loop_over_the_definitions_gives(case):
    frames, timer_ns, start_ns, end_ns = case
    traffic = np.array(frames, np.uint64).reshape(-1, 4)
    given_ns = None if timer_ns is None else np.array(timer_ns, np.int64)
    fast = timing_of(traffic, CONTRACT, BIT_RATE, start_ns, end_ns, given_ns)
    slow = slow_timing(frames, timer_ns, start_ns, end_ns)
    for name in FIGURES:
        figure = getattr(fast, name)
        rows = zip(figure.period.tolist(), figure.values.tolist(), strict=True)
        assert [(period, None if np.isnan(us) else us) for period, us in rows] == slow[name], name
    for name in COUNTS:
        assert getattr(fast, name).period.tolist() == slow[name], name
    assert fast.summary()["longest_gap_us"] == slow["longest_gap_us"]
    json.dumps(fast.summary(), allow_nan=False)
    all_limits = TimingLimits(0, 0, 0, 0, 0, 0)
    assert all("\n" not in str(broken) for broken in fast.violations(all_limits))


def slow_timing(frames, timer_ns, start_ns, end_ns):
    timer_ns = None if timer_ns is None else sorted(timer_ns)
    ends = {can_id: [end for end, other, *_ in frames if other == can_id] for can_id in END_OF}
    commands = ends[COMMAND]
    if timer_ns is None:
        payloads = [data for _, can_id, _, data in frames if can_id == COMMAND]
        timer_ns = sorted(
            end - (command_bits(data) - 3) * 1000 - EXECUTION_NS
            for end, data in zip(commands, payloads, strict=True)
        )
    first = next(k for k in range(20) if k * PERIOD_NS >= start_ns)
    periods = [k for k in range(20) if start_ns <= k * PERIOD_NS and (k + 1) * PERIOD_NS <= end_ns]

    def newest(can_id, at_ns):
        return max((end for end in ends[can_id] if end <= at_ns), default=None)

    def us(from_ns, to_ns):
        return None if from_ns is None else (to_ns - from_ns) / 1e3

    slow = {name: [] for name in (*FIGURES, *COUNTS)}
    for timer in timer_ns:
        if timer // PERIOD_NS in periods:
            number = timer // PERIOD_NS - first
            slow["feedback_age_us"].append((number, us(newest(FEEDBACK, timer), timer)))
            slow["setpoint_age_us"].append((number, us(newest(SETPOINT, timer), timer)))
    answered = set()
    for end, index in zip(commands, timers_of(commands, timer_ns), strict=True):
        if index is None or timer_ns[index] // PERIOD_NS not in periods:
            continue
        period = timer_ns[index] // PERIOD_NS
        slow["latency_us"].append((period - first, us(newest(FEEDBACK, timer_ns[index]), end)))
        if index not in answered and end > (period + 1) * PERIOD_NS:
            slow["late_periods"].append(period - first)
        answered.add(index)
    for before, end in pairwise(commands):
        for k in periods:
            if k * PERIOD_NS < end <= (k + 1) * PERIOD_NS:
                slow["jitter_us"].append((k - first, abs(end - before - PERIOD_NS) / 1e3))
    for k in periods:
        if not any(k * PERIOD_NS < end <= (k + 1) * PERIOD_NS for end in commands):
            slow["missed_periods"].append(k - first)
    slow["longest_gap_us"] = None
    if periods:
        begin, stop = periods[0] * PERIOD_NS, (periods[-1] + 1) * PERIOD_NS
        edges = [max((end for end in commands if end <= begin), default=begin)]
        edges += [end for end in commands if begin < end <= stop]
        edges.append(stop)
        slow["longest_gap_us"] = max(b - a for a, b in pairwise(edges)) / 1e3
    return slow


def timers_of(commands, timer_ns):
    """Index of each command's timer: the last one early enough; of several, the earlier take free ones."""
    last = [
        max((n for n, timer in enumerate(timer_ns) if timer <= end - EXECUTION_NS), default=None)
        for end in commands
    ]
    found = list(last)
    for n in range(len(commands) - 2, -1, -1):
        if last[n] is not None and last[n] == last[n + 1]:
            one_earlier = found[n + 1] - 1
            found[n] = one_earlier if one_earlier >= 0 and one_earlier not in last else found[n + 1]
    return found


def command_bits(*payloads: int) -> int:
    data = np.array(payloads, np.uint64)
    return int(reference_bits(np.full_like(data, COMMAND), False, 6, data)[0])


# the real bench, in virtual time


def bits_in_the_window(message) -> np.ndarray:
    """Length of a message's frames in the sine."""
    recording = played("sine").recording
    traffic = recording.traffic[recording.traffic[:, 0] >= recording.start_ns]
    frames = traffic[traffic[:, 1] == message.can_id]
    return reference_bits(frames[:, 1], False, message.dlc, frames[:, 3])


def test_every_period_of_the_sine_has_the_times_that_follow_from_its_frames_lengths():
    """Feedback leaves at +0, the setpoint after it, the command at +600 µs: at 1 Mbit/s one bit is 1 µs."""
    run = played("sine")
    feedback_us = bits_in_the_window(CONTRACT.position_feedback)
    setpoint_us = bits_in_the_window(CONTRACT.position_setpoint)
    command_us = bits_in_the_window(CONTRACT.drive_command)
    one = timing_in(run.recording, run.trace, CONTRACT, BIT_RATE, "inprocess")
    assert one.feedback_age_us.values.tolist() == (500 - (feedback_us - 3)).tolist()
    assert one.setpoint_age_us.values.tolist() == (500 - (feedback_us + setpoint_us - 3)).tolist()
    assert one.latency_us.values.tolist() == (600 + command_us - feedback_us).tolist()
    assert one.jitter_us.values[1:].tolist() == np.abs(np.diff(command_us)).tolist()
    assert one.feedback_age_us.period.tolist() == list(range(10_000))
    assert (len(one.missed_periods), len(one.late_periods)) == (0, 0)
    assert one.summary() == run.result["timing"]


def test_what_is_inferred_from_the_bus_is_what_was_recorded():
    """As far as the bus is free when the command is handed over, which at 1 Mbit/s it always is."""
    run = played("sine")
    recorded = timing_in(run.recording, run.trace, CONTRACT, BIT_RATE, "inprocess")
    unrecorded = replace(run.recording, controller=None)
    inferred = timing_in(unrecorded, run.trace, CONTRACT, BIT_RATE, "inprocess")
    assert (recorded.timer, inferred.timer) == (RECORDED, INFERRED)
    assert inferred.summary() | {"timer": RECORDED} == recorded.summary()
    for name in FIGURES:
        assert np.array_equal(getattr(inferred, name).values, getattr(recorded, name).values)


def test_a_real_time_run_is_not_blamed_for_the_period_at_whose_start_it_is_stopped():
    run = played("sine")
    assert timing_in(run.recording, run.trace, CONTRACT, BIT_RATE, "realtime").periods == 9_999


# violations in words


def words(traffic: np.ndarray, timer_ns=None, **limits) -> list[str]:
    return [str(broken) for broken in timing(traffic, timer_ns=timer_ns).violations(TimingLimits(**limits))]


def test_within_the_limits_there_is_nothing_to_say():
    figures = {"feedback_age_us": 400, "setpoint_age_us": 300, "latency_us": 600, "jitter_us": 0}
    assert words(chart(), **figures, missed_periods=0, late_periods=0) == []
    assert words(chart(without=[(FEEDBACK, 3), (COMMAND, 4)])) == [], "nothing is checked unless it is given"


def test_an_age_names_the_frame_and_the_timer():
    chart_ns = chart(without=[(FEEDBACK, 4)], ends_ns={(FEEDBACK, 3): 120_000})
    assert words(chart_ns, feedback_age_us=500) == [
        "period 4 (0.004 s): feedback age 1380.0 µs is above 500 µs: "
        "PositionFeedback (counter 3) ended at bus time 0.103120 s, controller timer at bus time 0.104500 s"
    ]
    assert words(chart(ends_ns={(SETPOINT, 7): 190_123}), setpoint_age_us=300.5) == [
        "period 7 (0.007 s): setpoint age 309.877 µs is above 300.5 µs: "
        "PositionSetpoint (counter 7) ended at bus time 0.107190 s, controller timer at bus time 0.107500 s"
    ]


def test_a_latency_names_the_whole_chain():
    assert words(chart(ends_ns={(COMMAND, 2): 900_000}), latency_us=700) == [
        "period 2 (0.002 s): latency 800.0 µs is above 700 µs: "
        "PositionFeedback (counter 2) ended at bus time 0.102100 s, controller timer at bus time 0.102500 s, "
        "DriveCommand (counter 2) ended at bus time 0.102900 s"
    ]


def test_jitter_names_both_commands():
    assert words(chart(ends_ns={(COMMAND, 9): 750_000}), jitter_us=20) == [
        "period 9 (0.009 s): command jitter 50.0 µs is above 20 µs: "
        "DriveCommand (counter 8) ended at bus time 0.108700 s, "
        "DriveCommand (counter 9) ended at bus time 0.109750 s"
    ]


def test_a_missed_period_names_the_last_command_and_the_latch():
    holes = chart(without=[(COMMAND, 4), (COMMAND, 7)])
    first, second = words(holes, missed_periods=0)
    assert first == (
        "period 4 (0.004 s): number of missed periods 1 is above 0: "
        "DriveCommand (counter 3) ended at bus time 0.103700 s, "
        "none from then to the latch at bus time 0.105000 s"
    )
    assert second.startswith("period 7 (0.007 s): number of missed periods 2 is above 0: ")
    assert words(holes, missed_periods=1) == [second.replace("above 0", "above 1")]
    assert words(holes, missed_periods=2) == []


def test_a_late_period_names_timer_command_and_latch():
    assert words(chart(ends_ns={(COMMAND, 4): 1_020_000}), late_periods=0) == [
        "period 4 (0.004 s): number of late periods 1 is above 0: controller timer at bus time 0.104500 s, "
        "DriveCommand (counter 4) ended at bus time 0.105020 s, latch at bus time 0.105000 s"
    ]


def test_violations_come_in_order_of_periods_and_carry_their_figures():
    delayed = chart(without=[(FEEDBACK, 3)], ends_ns={(COMMAND, 1): 1_020_000})
    found = timing(delayed).violations(TimingLimits(feedback_age_us=500, late_periods=0))
    assert [(broken.period, broken.figure, broken.value, broken.limit) for broken in found] == [
        (1, "late_periods", 1, 0),
        (3, "feedback_age_us", 1400.0, 500),
    ]
    assert found[1].time_s == 0.003


# limits of a scenario

GOOD = 'title = "t"\nreference = "sine"\nduration_s = 0.3\n'
RUN = ("--mode", "inprocess", "--json", "--out")


def scenario_file(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(GOOD + text)
    return str(path)


def test_a_scenario_without_timing_limits_has_none(tmp_path):
    assert load_scenario(scenario_file(tmp_path, "")).timing == TimingLimits()


def test_a_scenario_names_the_limits_it_wants(tmp_path):
    table = "[timing]\nlatency_us = 900\njitter_us = 12.5\nmissed_periods = 0\n"
    scenario = load_scenario(scenario_file(tmp_path, table))
    assert scenario.timing == TimingLimits(latency_us=900, jitter_us=12.5, missed_periods=0)
    cut = load_scenario(scenario_file(tmp_path, table), duration_s=0.1)
    assert cut.timing == TimingLimits(), "as its other limits"


ALLOWED = "feedback_age_us, setpoint_age_us, latency_us, jitter_us, missed_periods, late_periods"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("timing = 3\n", f"timing is 3, must be a table of limits: {ALLOWED}"),
        ("[timing]\nlatency_ms = 1\n", f"unknown key 'latency_ms' in timing; allowed are {ALLOWED}"),
        ('[timing]\nlatency_us = "900"\n', "timing.latency_us is '900', must be a number of µs from 0 on"),
        ("[timing]\nlatency_us = -1\n", "timing.latency_us is -1, must be a number of µs from 0 on"),
        ("[timing]\njitter_us = nan\n", "timing.jitter_us is nan, must be a number of µs from 0 on"),
        ("[timing]\njitter_us = true\n", "timing.jitter_us is True, must be a number of µs from 0 on"),
        ("[timing]\nlate_periods = 0.5\n", "timing.late_periods is 0.5, must be a whole number from 0 on"),
        ("[timing]\nmissed_periods = []\n", "timing.missed_periods is [], must be a whole number from 0 on"),
    ],
)
def test_a_malformed_timing_table(tmp_path, text, what):
    file = scenario_file(tmp_path, text)
    with pytest.raises(ScenarioError) as refused:
        load_scenario(file)
    line = GOOD.count("\n") + text.count("\n")
    assert str(refused.value) == f"{file}: line {line}: {what}"


def test_limits_that_are_met_are_in_the_result(tmp_path, capsys):
    file = scenario_file(tmp_path, "[timing]\nlatency_us = 900\nmissed_periods = 0\nlate_periods = 0\n")
    assert cli.main(["run", file, *RUN, str(tmp_path / "out")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["within_limits"] is True
    assert result["timing_limits"] == {"latency_us": 900, "missed_periods": 0, "late_periods": 0}


def test_limits_that_are_missed_are_an_exit_code_and_one_line(tmp_path, capsys):
    file = scenario_file(tmp_path, "[timing]\nlatency_us = 500\n")
    assert cli.main(["run", file, "--controller", "adrc", *RUN, str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith(
        "hil: timing limits were broken 300 times, first in period 0 (0.000 s): latency 600.0 µs is above "
        "500 µs: PositionFeedback (counter 5) ended at bus time 0.100100 s, "
    )
    result = json.loads(said.out)
    assert result["within_limits"] is False
    assert f"hil: {result['verdict']}" == line


def judged(recording=None, **changes) -> tuple[bool | None, str]:
    """Judge the sine, or another recording, by other limits."""
    run = played("sine")
    options = RunOptions(replace(load_scenario("sine"), **changes), "adrc", record_directory=Path())
    result = result_of(recording or run.recording, run.trace, CONTRACT, options, "inprocess")
    return result["within_limits"], result["verdict"]


def test_timing_and_tracking_are_judged_together():
    good, broken = TimingLimits(latency_us=608), TimingLimits(latency_us=607)
    strict = {"adrc": {"rms_mm": 1e-6, "max_mm": 1e-6}}
    assert judged(timing=good) == (True, "")
    assert judged(limits={}) == (None, "")
    assert judged(limits={}, timing=good) == (True, "")
    assert judged(limits=strict, timing=good) == (False, "the scenario's limits were missed")
    within, verdict = judged(limits=strict, timing=broken)
    assert within is False
    assert verdict.startswith("the scenario's limits were missed; timing limits were broken ")


def test_a_broken_timing_alone_misses_the_limits():
    recording = played("sine").recording
    commands = np.flatnonzero(recording.traffic[:, 1] == COMMAND)
    missing = commands[100 + 1234]
    silent_once = replace(recording, traffic=np.delete(recording.traffic, missing, axis=0))
    within, verdict = judged(silent_once, timing=TimingLimits(missed_periods=0))
    assert within is False
    assert verdict.startswith(
        "timing limits were broken once, first in period 1234 (1.234 s): number of missed periods 1 is "
    )


def test_a_real_time_run_that_the_machine_did_not_keep_up_with_is_told():
    recording = replace(played("sine").recording, notes={"rt_ratio": 0.5})
    commands = np.flatnonzero(recording.traffic[:, 1] == COMMAND)
    behind = replace(recording, traffic=np.delete(recording.traffic, commands[1334], axis=0))
    options = RunOptions(load_scenario("sine"), "adrc", record_directory=Path())

    def told(recording: Recording, mode: str) -> str:
        return overrun_of(result_of(recording, played("sine").trace, CONTRACT, options, mode))

    assert told(behind, "realtime") == (
        "1 of 9999 periods missed, 0 late: this machine or its bus did not keep up; try --rt-ratio below 0.5"
    )
    assert told(recording, "realtime") == ""
    assert told(behind, "lockstep") == ""


def test_a_run_that_was_cut_short_is_not_judged():
    recording = replace(played("sine").recording, ending="interrupted")
    assert judged(recording, timing=TimingLimits(latency_us=0)) == (None, "")
