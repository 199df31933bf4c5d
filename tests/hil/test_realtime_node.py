"""The real-time engine, against a clock and a bus of the test's own: exact, whatever this machine does."""

import os
import random
import socket
import sys
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from threading import Thread
from types import SimpleNamespace

import can
import numpy as np
import pytest
from bench_runs import serving, wait_until

from dbc.frame import Frame
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from hil.bus.hilbus import HilBus
from hil.bus.wire import Clock
from hil.run import realtime
from hil.run.realtime import CATCH_UP_FRAMES, LAST_LOOK_NS, SPIN_NS, TICK_MARGIN_NS, Lateness, RealtimeNode

POWER_ON_NS = 7_000_323_456
FIRST_DUE_NS = 7_001_000_000 + TICK_MARGIN_NS
"""Wall time of the first period after power-on."""
CLOCK_READ_NS = 100
RECV_NS = 2_000
RESOLUTION_NS = 2 * RECV_NS + 10 * CLOCK_READ_NS
"""As late as a timer is beyond what disturbs it: two looks at the bus."""


def us(value: float) -> int:
    return round(value * 1e3)


class Machine:
    """A wall clock that moves when it is read or slept on, and a bus that frames arrive on.

    Parameters
    ----------
    oversleep_ns : callable
        How much longer than asked the next sleep takes.
    """

    channel_info = "the bus of the test"

    def __init__(self, oversleep_ns: Callable[[], int] = lambda: 0) -> None:
        self.now_ns = POWER_ON_NS
        self.looks = 0
        self.sent: list[tuple[int, int]] = []
        self.arriving: deque[tuple[int, int]] = deque()
        self._oversleep_ns = oversleep_ns

    def monotonic_ns(self) -> int:
        self.now_ns += CLOCK_READ_NS
        return self.now_ns

    def recv(self, timeout: float) -> can.Message | None:
        self.now_ns += RECV_NS
        if not (self.arriving and self.arriving[0][0] <= self.now_ns):
            if timeout == 0:
                self.looks += 1
                return None
            until_ns = self.now_ns + round(timeout * 1e9)
            if self.arriving:
                until_ns = min(until_ns, self.arriving[0][0])
            self.now_ns = max(self.now_ns, until_ns + self._oversleep_ns())
        if self.arriving and self.arriving[0][0] <= self.now_ns:
            return can.Message(arbitration_id=self.arriving.popleft()[1], is_extended_id=False)
        return None

    def send(self, message: can.Message) -> None:
        self.sent.append((self.now_ns, message.arbitration_id))

    def fileno(self) -> int:
        raise NotImplementedError

    def runner(self, node: object, ratio: Fraction = Fraction(1), clock: Clock | None = None) -> RealtimeNode:
        return RealtimeNode(node, self, ratio, clock or Clock(), self.monotonic_ns)

    def run(self, node: "Ticker", periods: int, **parameters) -> RealtimeNode:
        """Power a node on and run it until its timer was called so many times."""
        runner = self.runner(node, **parameters)
        runner.start()
        runner.run(lambda: len(node.calls) < periods)
        return runner


class Ticker:
    """A node that notes its calls, by the machine's clock and by what it was told."""

    name = "ticker"
    accepts = None
    latched: frozenset[int] = frozenset()
    transmits = frozenset({0x100})

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.starts = 0
        self.calls: list[int] = []
        self.told: list[int] = []
        self.heard: list[tuple[int, int]] = []
        self.duration_ns: dict[int, int] = {}
        self.send_after_ns: tuple[int, ...] = ()

    def on_start(self, now_ns: int) -> Actions:
        self.starts += 1
        return Actions(next_period(now_ns))

    def on_timer(self, now_ns: int) -> Actions:
        self.machine.now_ns += self.duration_ns.get(len(self.calls), 0)
        self.calls.append(self.machine.now_ns)
        self.told.append(now_ns)
        sends = [(now_ns + after, Frame(0x100 + i, 0, 0)) for i, after in enumerate(self.send_after_ns)]
        return Actions(next_period(now_ns + 1), tuple(sends))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.heard.append((len(self.calls), frame.can_id))
        return NOTHING


def lateness_ns(calls: list[int], period_ns: int = PERIOD_NS) -> np.ndarray:
    """Return how long after its own deadline each call came, counted from the first deadline."""
    return np.array(calls) - (FIRST_DUE_NS + period_ns * np.arange(len(calls)))


# deadlines


def test_every_period_has_its_call_and_nothing_adds_up_over_ten_thousand():
    random_ns = random.Random(1)
    machine = Machine(oversleep_ns=lambda: random_ns.randrange(SPIN_NS - RECV_NS))
    node = Ticker(machine)
    machine.run(node, 10_000)
    late_ns = lateness_ns(node.calls)
    assert late_ns.min() >= 0
    assert late_ns.max() <= RESOLUTION_NS


def test_sleeps_that_end_late_make_their_own_call_late_and_no_other():
    random_ns = random.Random(1)
    machine = Machine(oversleep_ns=lambda: random_ns.randrange(us(900)))
    node = Ticker(machine)
    runner = machine.run(node, 10_000)
    late_ns = lateness_ns(node.calls)
    assert late_ns.min() >= 0
    assert late_ns.max() <= us(900) - SPIN_NS + RESOLUTION_NS
    assert runner.lateness.overruns == 0


def test_periods_begin_away_from_the_tick_of_the_kernel():
    machine = Machine()
    node = Ticker(machine)
    machine.run(node, 3)
    assert {call // us(50) % 20 for call in node.calls} == {TICK_MARGIN_NS // us(50)}


def test_a_tenth_of_real_time_makes_the_same_periods_ten_times_longer():
    machine = Machine()
    node = Ticker(machine)
    runner = machine.run(node, 100, ratio=Fraction(1, 10))
    assert np.diff(node.calls) == pytest.approx(10 * PERIOD_NS, abs=RESOLUTION_NS)
    assert np.diff(node.told) == pytest.approx(PERIOD_NS, abs=RESOLUTION_NS / 10)
    assert max(runner.lateness.timer_ns) <= RESOLUTION_NS


@pytest.mark.parametrize("clock", [Clock(500_000), Clock(500_000, 50_000), Clock(0, -50_000)])
def test_a_node_lives_by_its_own_clock(clock: Clock):
    machine = Machine()
    node = Ticker(machine)
    machine.run(node, 1000, clock=clock)
    shared = np.array(node.calls) - TICK_MARGIN_NS - clock.phase_ns
    own = shared * (1 + clock.drift_ppb * 1e-9)
    assert np.abs(own - PERIOD_NS * np.round(own / PERIOD_NS)).max() <= RESOLUTION_NS
    assert np.diff(own) == pytest.approx(PERIOD_NS, abs=RESOLUTION_NS)


def test_polling_is_bounded_by_the_window():
    machine = Machine()
    node = Ticker(machine)
    machine.run(node, 100)
    assert 0 < machine.looks <= 100 * (SPIN_NS // RECV_NS)


def test_an_interface_that_returns_too_early_is_not_polled_outside_the_window():
    machine = Machine(oversleep_ns=lambda: -us(50))
    node = Ticker(machine)
    machine.run(node, 100)
    assert machine.looks <= 100 * (SPIN_NS // RECV_NS)
    assert lateness_ns(node.calls).max() <= RESOLUTION_NS


# sends


def test_what_the_node_sends_later_leaves_at_its_time_and_in_order():
    machine = Machine()
    node = Ticker(machine)
    node.send_after_ns = (us(100), us(300), 0, us(100))
    machine.run(node, 51)
    assert [can_id for _, can_id in machine.sent[:200]] == [0x102, 0x100, 0x103, 0x101] * 50
    after_ns = np.array([time_ns for time_ns, _ in machine.sent[:200]]).reshape(50, 4)
    after_ns -= FIRST_DUE_NS + PERIOD_NS * np.arange(50)[:, None]
    assert after_ns.min(axis=0) == pytest.approx([0, us(100), us(100), us(300)], abs=2 * RESOLUTION_NS)
    assert after_ns.max(axis=0) == pytest.approx([0, us(100), us(100), us(300)], abs=2 * RESOLUTION_NS)


def test_a_send_that_is_due_before_the_timer_leaves_before_it_even_when_both_are_late():
    oversleeps = iter([0, 0, us(2500)])
    machine = Machine(oversleep_ns=lambda: next(oversleeps, 0))
    node = Ticker(machine)
    node.send_after_ns = (us(600),)
    machine.run(node, 2)
    assert len(machine.sent) == 1
    assert machine.sent[0][0] < node.calls[1]


# frames and the timer


def test_a_frame_that_is_there_before_the_deadline_is_delivered_before_the_timer():
    machine = Machine()
    node = Ticker(machine)
    earlier = [us(800), us(150), us(20), LAST_LOOK_NS + RECV_NS]
    machine.arriving.extend((FIRST_DUE_NS + PERIOD_NS - ns, i) for i, ns in enumerate(earlier))
    machine.arriving.append((FIRST_DUE_NS + PERIOD_NS + us(1), 0x7))
    machine.run(node, 3)
    assert node.heard == [(1, 0), (1, 1), (1, 2), (1, 3), (2, 0x7)]
    assert lateness_ns(node.calls).max() <= RESOLUTION_NS


def test_frames_that_came_during_a_stall_are_delivered_before_the_late_timer():
    oversleeps = iter([us(5000)])
    machine = Machine(oversleep_ns=lambda: next(oversleeps, 0))
    node = Ticker(machine)
    stalled = [(FIRST_DUE_NS + i * us(10), i) for i in range(CATCH_UP_FRAMES + 10)]
    machine.arriving.append((FIRST_DUE_NS - us(500), 0x7FF))
    machine.arriving.extend(stalled)
    machine.run(node, 2)
    before = [can_id for calls, can_id in node.heard if calls == 0]
    assert before == [0x7FF, *range(CATCH_UP_FRAMES)]
    assert len(node.heard) == 1 + len(stalled)


def test_a_flood_of_frames_delays_the_timer_by_one_frame_at_most():
    machine = Machine()
    node = Ticker(machine)
    machine.arriving.extend((POWER_ON_NS, 0x1) for _ in range(20_000))
    machine.run(node, 20)
    assert lateness_ns(node.calls).max() <= RECV_NS + RESOLUTION_NS
    assert len(node.heard) > 20 * PERIOD_NS // (2 * RECV_NS)


def test_a_node_that_takes_longer_than_its_period_still_hears_its_frames():
    machine = Machine()
    node = Ticker(machine)
    node.duration_ns = dict.fromkeys(range(100), us(1500))
    machine.arriving.extend((FIRST_DUE_NS + i * us(500), 0x1) for i in range(200))
    machine.run(node, 60)
    assert len(node.heard) >= 170


def test_an_interface_that_holds_more_than_its_descriptor_shows_is_read_to_the_end():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        machine = Machine()
        machine.fileno = ours.fileno  # never readable
        node = Ticker(machine)
        machine.arriving.extend((FIRST_DUE_NS - us(100), i) for i in range(5))
        machine.arriving.appendleft((FIRST_DUE_NS - us(300), 0x7FF))
        runner = machine.runner(node)
        runner.start()
        machine.now_ns = FIRST_DUE_NS - us(400)
        oversleeps = iter([us(250)])
        machine._oversleep_ns = lambda: next(oversleeps, 0)
        runner.run(lambda: not node.calls)
        assert [can_id for _, can_id in node.heard] == [0x7FF, *range(5)]


def test_only_accepted_data_frames_reach_the_node():
    machine = Machine()
    node = Ticker(machine)
    node.accepts = frozenset({0x5})
    machine.arriving.extend((FIRST_DUE_NS, can_id) for can_id in (0x4, 0x5, 0x6))
    machine.run(node, 3)
    assert [can_id for _, can_id in node.heard] == [0x5]


# overruns


class Stubborn(Ticker):
    """A node that asks for every period, gone by or not."""

    def on_timer(self, now_ns: int) -> Actions:
        super().on_timer(now_ns)
        self.due_ns = getattr(self, "due_ns", self.told[0] // PERIOD_NS * PERIOD_NS) + PERIOD_NS
        return Actions(self.due_ns)


@pytest.mark.parametrize("kind", [Ticker, Stubborn])
def test_missed_periods_are_counted_and_not_made_up_for(kind: type[Ticker]):
    oversleeps = iter([0] * 9 + [us(3700)])  # of a sleep that ends 200 µs before the deadline
    machine = Machine(oversleep_ns=lambda: next(oversleeps, 0))
    node = kind(machine)
    runner = machine.run(node, 20)
    late_by_ns = us(3500)
    assert node.calls[9] - (FIRST_DUE_NS + 9 * PERIOD_NS) == pytest.approx(late_by_ns, abs=RESOLUTION_NS)
    assert node.calls[10] - (FIRST_DUE_NS + 13 * PERIOD_NS) <= RESOLUTION_NS
    assert node.told[9] % PERIOD_NS == pytest.approx(us(500), abs=RESOLUTION_NS)
    late = runner.lateness
    assert (late.overruns, late.stalls) == (3, 1)
    [(due_ns, stall_ns)] = late.longest_stalls
    assert due_ns == node.told[9] // PERIOD_NS * PERIOD_NS - 3 * PERIOD_NS
    assert stall_ns == pytest.approx(late_by_ns, abs=RESOLUTION_NS)


def test_lateness_is_wall_time_and_overruns_are_node_periods():
    oversleeps = iter([us(3700)])
    machine = Machine(oversleep_ns=lambda: next(oversleeps, 0))
    runner = machine.run(Ticker(machine), 2, ratio=Fraction(1, 10))
    assert max(runner.lateness.timer_ns) == pytest.approx(us(3500), abs=RESOLUTION_NS)
    assert runner.lateness.overruns == 0


def test_the_summary_gives_percentiles_in_us_and_keeps_the_longest_stalls():
    late = Lateness()
    for number in range(1, 1001):
        late.note(number * PERIOD_NS, number * 1000, missed=int(number > 900))
    summary = late.summary()
    assert summary["p50_us"] == pytest.approx(500.5)
    assert summary["p99_us"] == pytest.approx(990.01)
    assert summary["p999_us"] == pytest.approx(999.001)
    assert summary["max_us"] == 1000
    assert (summary["overruns"], summary["stalls"]) == (100, 100)
    kept = summary["longest_stalls_ns"]
    assert kept == [(number * PERIOD_NS, number * 1000) for number in range(981, 1001)]


# starting, stopping, going on


def test_running_again_goes_on_with_the_same_node_and_skips_the_pause():
    machine = Machine()
    node = Ticker(machine)
    runner = machine.run(node, 10)
    machine.now_ns += us(7300)
    runner.run(lambda: len(node.calls) < 20)
    assert node.starts == 1
    assert runner.lateness.overruns == 0
    assert lateness_ns(node.calls[:10]).max() <= RESOLUTION_NS
    assert (node.calls[10] - FIRST_DUE_NS) // PERIOD_NS == 17
    assert len(runner.lateness.timer_ns) == 20


def test_it_is_asked_at_least_every_50_ms_whether_to_go_on():
    machine = Machine()
    node = Ticker(machine)
    asked: list[int] = []
    runner = machine.runner(node)  # not started: nothing is ever due
    runner.run(lambda: asked.append(machine.now_ns) or len(asked) < 20)
    assert np.diff(asked).max() <= us(50_000)


@pytest.mark.parametrize("entry_point", ["on_timer", "on_frame"])
def test_what_the_node_raises_comes_out_of_run(entry_point: str):
    machine = Machine()
    node = Ticker(machine)
    machine.arriving.append((FIRST_DUE_NS, 0x1))

    def fail(*_: object) -> Actions:
        raise RuntimeError("broken")

    setattr(node, entry_point, fail)
    with pytest.raises(RuntimeError, match="broken"):
        machine.run(node, 5)


# the thread it runs in


def test_a_bench_can_run_a_node_in_a_thread_and_have_its_interpreter_back():
    interval_s = sys.getswitchinterval()
    policies = []
    with serving("test"), HilBus("test") as bus:
        machine = SimpleNamespace(now_ns=0)
        node = Ticker(machine)
        runner = RealtimeNode(node, bus, Fraction(1), Clock())
        going = True

        def in_thread() -> None:
            policies.append(os.sched_getscheduler(0))
            runner.start()
            runner.run(lambda: going)
            policies.append(os.sched_getscheduler(0))

        thread = Thread(target=in_thread)
        thread.start()
        wait_until(lambda: len(node.calls) > 5, "the timer was called")
        going = False
        thread.join()
    assert policies[0] == policies[1] == os.sched_getscheduler(0)
    assert sys.getswitchinterval() == interval_s
    assert runner.lateness.scheduler in ("fifo", "other")


def test_a_lost_hub_comes_out_of_run():
    machine = SimpleNamespace(now_ns=0)
    node = Ticker(machine)
    with serving("test"):
        bus = HilBus("test")
    with bus:
        runner = RealtimeNode(node, bus, Fraction(1), Clock())
        runner.start()
        with pytest.raises(can.CanOperationError, match="has ended"):
            runner.run(lambda: True)


def test_without_permission_the_scheduler_stays_as_it_was(monkeypatch):
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with realtime.fifo_scheduling() as scheduler:
        assert scheduler == "other"


def test_a_system_without_schedulers_to_choose_from_runs_all_the_same(monkeypatch):
    monkeypatch.delattr(os, "sched_setscheduler")
    with realtime.fifo_scheduling() as scheduler:
        assert scheduler == "other"


def test_a_thread_under_fifo_already_keeps_its_priority():
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))
    except OSError:
        pytest.skip("SCHED_FIFO is not permitted here")
    try:
        with realtime.fifo_scheduling() as scheduler:
            assert scheduler == "fifo"
            assert os.sched_getparam(0).sched_priority == 7
        assert os.sched_getscheduler(0) == os.SCHED_FIFO
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
