"""The wire: who speaks when, to the nanosecond, and that nothing is lost or reordered."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.frame import EFF_FLAG, Frame
from dbc.node import NOTHING, Actions
from hil.bus.wire import NEVER, Clock, Wire, arbitration_key
from hil.bus.wire_time import classic_bits

BIT_NS = 1000
"""At 1 Mbit/s."""

BITS_0X123 = 125  # 8 zero bytes, stuff bits and intermission included
BITS_EMPTY_0 = 53
QUIET = Frame(0x123, 8, 0)
URGENT = Frame(0x000, 0, 0)


class Talker:
    """Sends given frames at its timer, each handed over at its own time, and notes all it hears."""

    latched = transmits = frozenset()

    def __init__(
        self,
        name: str,
        sends: Iterable[tuple[int, Frame]] = (),
        timer_ns: int | None = None,
        accepts: frozenset[int] | None = None,
        diary: list[tuple[str, str, int]] | None = None,
    ) -> None:
        self.name = name
        self.accepts = accepts
        self.heard: list[tuple[int, Frame]] = []
        self.woken: list[int] = []
        self._sends = tuple(sends)
        self._timer_ns = min((at for at, _ in self._sends), default=None) if timer_ns is None else timer_ns
        self._diary = [] if diary is None else diary

    def on_start(self, now_ns: int) -> Actions:
        return Actions(self._timer_ns)

    def on_timer(self, now_ns: int) -> Actions:
        self.woken.append(now_ns)
        self._diary.append((self.name, "timer", now_ns))
        return Actions(sends=self._sends)

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.heard.append((now_ns, frame))
        self._diary.append((self.name, "frame", now_ns))
        return NOTHING


def wire_of(*nodes: Talker, bit_rate: int = 1_000_000, out_of_band: frozenset[int] = frozenset()) -> Wire:
    wire = Wire(bit_rate, out_of_band)
    for port in [wire.attach(node) for node in nodes]:
        wire.start(port)
    return wire


def traffic(wire: Wire) -> list[tuple[int, Frame]]:
    return [(time_ns, Frame(*frame)) for time_ns, *frame in wire.traffic.tolist()]


# frame times


@pytest.mark.parametrize(
    ("frame", "bits"),
    [
        (Frame(0x123, 8, 0), 125),
        (Frame(0x7FF, 8, 0xFFFF_FFFF_FFFF_FFFF), 126),
        (Frame(0x555, 8, 0x5555_5555_5555_5555), 112),
        (Frame(0x000, 0, 0), 53),
        (Frame(0x101, 8, 0x0807_0605_0403_0201), 121),
        (Frame(0x1FFF_FFFF | EFF_FLAG, 8, 0xFFFF_FFFF_FFFF_FFFF), 149),
        (Frame(0x0 | EFF_FLAG, 8, 0), 150),
    ],
)
@pytest.mark.parametrize("bit_rate", [1_000_000, 500_000, 125_000])
def test_a_frame_is_heard_at_the_end_of_its_end_of_frame(frame, bits, bit_rate):
    listener = Talker("listener")
    wire = wire_of(Talker("sender", [(7_000, frame)]), listener, bit_rate=bit_rate)
    wire.run(10_000_000)
    end_ns = 7_000 + (bits - 3) * 1_000_000_000 // bit_rate
    assert listener.heard == [(end_ns, frame)]
    assert traffic(wire) == [(end_ns, frame)]


def test_the_next_frame_starts_after_three_bits_of_intermission():
    listener = Talker("listener")
    wire_of(Talker("sender", [(0, QUIET), (0, QUIET)]), listener).run(1_000_000)
    first_ns, second_ns = (time_ns for time_ns, _ in listener.heard)
    assert first_ns == (BITS_0X123 - 3) * BIT_NS
    assert second_ns == BITS_0X123 * BIT_NS + (BITS_0X123 - 3) * BIT_NS


def test_a_bit_time_that_is_no_whole_number_of_nanoseconds_does_not_add_up():
    listener = Talker("listener")
    wire_of(Talker("sender", [(0, URGENT)]), listener, bit_rate=83_333).run(10_000_000)
    assert listener.heard[0][0] == 50 * 10**9 // 83_333


def test_the_sender_does_not_hear_itself():
    sender, listener = Talker("sender", [(0, QUIET)]), Talker("listener")
    wire_of(sender, listener).run(1_000_000)
    assert sender.heard == []
    assert len(listener.heard) == 1


def test_the_acceptance_filter_tells_standard_from_extended_identifiers():
    extended = Frame(0x123 | EFF_FLAG, 0, 0)
    picky, deaf, curious = (
        Talker("picky", accepts=frozenset({0x123})),
        Talker("deaf", accepts=frozenset()),
        Talker("curious"),
    )
    wire_of(Talker("sender", [(0, QUIET), (0, extended)]), picky, deaf, curious).run(1_000_000)
    assert [frame for _, frame in picky.heard] == [QUIET]
    assert deaf.heard == []
    assert [frame for _, frame in curious.heard] == [extended, QUIET]


# release


def test_a_frame_waits_for_the_time_at_which_it_is_handed_over():
    listener = Talker("listener")
    sender = Talker("sender", [(100_000, QUIET)], timer_ns=0)
    wire_of(sender, listener).run(1_000_000)
    assert sender.woken == [0]
    assert listener.heard[0][0] == 100_000 + (BITS_0X123 - 3) * BIT_NS


def test_a_frame_handed_over_during_intermission_competes_for_the_bus_at_its_end():
    listener = Talker("listener")
    end_ns = BITS_0X123 * BIT_NS
    wire = wire_of(
        Talker("first", [(0, QUIET)]),
        Talker("low", [(end_ns - 3_000, Frame(0x700, 0, 0))]),
        Talker("high", [(end_ns - 1, URGENT)]),
        listener,
    )
    wire.run(1_000_000)
    assert [frame.can_id for _, frame in listener.heard] == [0x123, 0x000, 0x700]
    assert listener.heard[1][0] == end_ns + (BITS_EMPTY_0 - 3) * BIT_NS


def test_frames_of_one_node_and_id_leave_in_the_order_in_which_they_were_handed_over():
    """Not in the order in which the node announced them."""
    listener = Talker("listener")
    early, late = Frame(0x100, 1, 1), Frame(0x100, 1, 2)
    wire = wire_of(
        Talker("busy", [(0, QUIET)]), Talker("sender", [(90_000, late), (50_000, early)], 10_000), listener
    )
    wire.run(1_000_000)
    assert [frame for _, frame in listener.heard] == [QUIET, early, late]


# arbitration


def test_the_lowest_identifier_wins_whoever_asked_first():
    listener = Talker("listener")
    wire = wire_of(
        Talker("first", [(0, QUIET)]),
        Talker("third", [(1_000, Frame(0x7FF, 0, 0))]),
        Talker("second", [(2_000, Frame(0x0FF, 0, 0))]),
        listener,
    )
    wire.run(1_000_000)
    assert [frame.can_id for _, frame in listener.heard] == [0x123, 0x0FF, 0x7FF]


def test_a_standard_frame_beats_an_extended_one_with_the_same_base():
    base = 0x123
    same_base, higher_base, lower_base = (
        EFF_FLAG | base << 18,
        EFF_FLAG | (base + 1) << 18,
        EFF_FLAG | (base - 1) << 18 | 0x3FFFF,
    )
    ids = [higher_base, base + 1, same_base | 1, same_base, base, lower_base]
    listener = Talker("listener")
    wire_of(Talker("sender", [(0, Frame(can_id, 0, 0)) for can_id in ids]), listener).run(1_000_000)
    assert [frame.can_id for _, frame in listener.heard] == [
        lower_base,
        base,
        same_base,
        same_base | 1,
        base + 1,
        higher_base,
    ]


@st.composite
def can_ids(draw):
    if draw(st.booleans()):
        return draw(st.integers(0, 0x7FF))
    return EFF_FLAG | draw(st.integers(0, 0x7FF)) << 18 | draw(st.sampled_from([0, 1, 0x3FFFE, 0x3FFFF]))


def arbitration_field(can_id: int) -> str:
    """The bits that compete, '0' dominant: base, RTR or SRR, IDE, extension, RTR."""
    if can_id & EFF_FLAG:
        return f"{can_id >> 18 & 0x7FF:011b}11{can_id & 0x3FFFF:018b}0"
    return f"{can_id:011b}00"


@given(can_ids(), can_ids())
def test_the_arbitration_key_orders_as_the_bits_on_the_wire_do(one, other):
    assert (arbitration_key(one) < arbitration_key(other)) == (
        arbitration_field(one) < arbitration_field(other)
    )


# ties at one instant


def test_a_frame_that_ends_is_heard_before_the_timer_of_that_instant():
    diary = []
    end_ns = (BITS_0X123 - 3) * BIT_NS
    sleeper = Talker("sleeper", timer_ns=end_ns, diary=diary)
    wire_of(Talker("sender", [(0, QUIET)]), sleeper).run(1_000_000)
    assert diary == [("sleeper", "frame", end_ns), ("sleeper", "timer", end_ns)]


def test_timers_of_one_instant_fire_in_the_order_of_attachment():
    diary = []
    names = ["b", "a", "d", "c"]
    wire_of(*(Talker(name, timer_ns=5_000, diary=diary) for name in names)).run(10_000)
    assert [name for name, _, _ in diary] == names


def test_arbitration_waits_for_every_timer_of_its_instant():
    listener = Talker("listener")
    wire_of(Talker("low", [(5_000, QUIET)]), Talker("high", [(5_000, URGENT)]), listener).run(1_000_000)
    assert [frame for _, frame in listener.heard] == [URGENT, QUIET]


def test_arbitration_waits_for_every_frame_handed_over_at_its_instant():
    listener = Talker("listener")
    low, high = Talker("low", [(5_000, QUIET)]), Talker("high", [(5_000, URGENT)], timer_ns=0)
    wire_of(low, high, listener).run(1_000_000)
    assert [frame for _, frame in listener.heard] == [URGENT, QUIET]


def test_of_equal_identifiers_the_first_node_wins():
    listener = Talker("listener")
    mine, yours = Frame(0x100, 1, 1), Frame(0x100, 1, 2)
    wire_of(Talker("first", [(0, mine)]), Talker("second", [(0, yours)]), listener).run(1_000_000)
    assert [frame for _, frame in listener.heard] == [mine, yours]


def test_a_wake_up_in_the_past_happens_now():
    late = Talker("late", timer_ns=10)
    wire = wire_of()
    wire.run(1_000)
    wire.start(wire.attach(late))
    wire.run(2_000)
    assert late.woken == [1_000]


# out of band

LOAD = Frame(0x1FFF_0002 | EFF_FLAG, 4, 1234)
OUT_OF_BAND = frozenset({LOAD.can_id})


def test_an_out_of_band_frame_arrives_at_once_on_a_busy_bus_and_takes_no_bus_time():
    listener = Talker("listener")
    wire = wire_of(
        Talker("sender", [(0, QUIET)]), Talker("bench", [(50_000, LOAD)]), listener, out_of_band=OUT_OF_BAND
    )
    wire.run(1_000_000)
    assert listener.heard == [(50_000, LOAD), ((BITS_0X123 - 3) * BIT_NS, QUIET)]


def test_an_out_of_band_frame_comes_after_the_timers_of_its_instant():
    diary = []
    bench = Talker("bench", [(5_000, LOAD)])
    wire_of(bench, Talker("plant", timer_ns=5_000, diary=diary), out_of_band=OUT_OF_BAND).run(10_000)
    assert [what for _, what, _ in diary] == ["timer", "frame"]


def test_an_out_of_band_frame_keeps_its_hand_over_time_and_passes_the_filters():
    picky, sender = Talker("picky", accepts=frozenset({QUIET.can_id})), Talker("sender", [(9_000, LOAD)], 0)
    listener = Talker("listener")
    wire_of(sender, picky, listener, out_of_band=OUT_OF_BAND).run(10_000)
    assert listener.heard == [(9_000, LOAD)]
    assert picky.heard == sender.heard == []


# clocks


@given(
    time_ns=st.integers(-(10**15), 10**15),
    phase_ns=st.integers(-(10**9), 10**9),
    drift_ppb=st.integers(-(10**8), 10**8),
)
def test_a_clock_finds_the_first_bus_time_that_is_not_too_early(time_ns, phase_ns, drift_ppb):
    clock = Clock(phase_ns, drift_ppb)
    bus_ns = clock.bus(time_ns)
    assert clock.local(bus_ns) >= time_ns
    assert clock.local(bus_ns - 1) < time_ns


def test_phase_and_drift_move_what_a_node_is_told_and_when_it_is_woken():
    wire = Wire(1_000_000)
    late, fast, sender = (
        Talker("late", timer_ns=1_000_000),
        Talker("fast", timer_ns=1_000_000),
        Talker("sender", [(2_000_000, QUIET)]),
    )
    for node, clock in ((late, Clock(500_000)), (fast, Clock(0, 100_000)), (sender, None)):
        wire.start(wire.attach(node, clock))
    wire.run(1_500_000)
    assert late.woken == []
    wire.run(3_000_000)
    assert late.woken == [1_000_000]
    assert fast.woken == [1_000_000]  # at bus time 999 901, rounded up to its own 1 ms
    end_ns = 2_000_000 + (BITS_0X123 - 3) * BIT_NS
    assert late.heard == [(end_ns - 500_000, QUIET)]
    assert fast.heard == [(end_ns + end_ns // 10_000, QUIET)]


class Ticker(Talker):
    """Wakes every millisecond of its own clock."""

    def on_timer(self, now_ns: int) -> Actions:
        self.woken.append(now_ns)
        return Actions((now_ns // 1_000_000 + 1) * 1_000_000)


@pytest.mark.parametrize(("drift_ppm", "periods"), [(-10_000, 990), (0, 1000), (10_000, 1010)])
def test_a_drifting_node_counts_more_or_fewer_periods(drift_ppm, periods):
    ticker = Ticker("ticker", timer_ns=1_000_000)
    wire = Wire(1_000_000)
    wire.start(wire.attach(ticker, Clock(0, drift_ppm * 1000)))
    wire.run(1_000_000_001)
    assert len(ticker.woken) == periods
    assert all(later // 1_000_000 - earlier // 1_000_000 == 1 for earlier, later in pairwise(ticker.woken))


# coming and going


def test_a_node_that_is_cut_off_neither_hears_nor_sends():
    gone, listener = Talker("gone", [(300_000, URGENT), (10_000, URGENT)], timer_ns=0), Talker("listener")
    wire = Wire(1_000_000)
    sender = Talker("sender", [(0, QUIET), (0, QUIET)])
    ports = [wire.attach(node) for node in (gone, sender, listener)]
    for port in ports:
        wire.start(port)
    wire.run(20_000)
    wire.detach(ports[0])
    wire.run(1_000_000)
    assert gone.heard == []
    assert [frame for _, frame in listener.heard] == [QUIET, QUIET]


def test_a_node_that_is_cut_off_does_not_wake():
    sleeper = Talker("sleeper", timer_ns=5_000)
    wire = Wire(1_000_000)
    port = wire.attach(sleeper)
    wire.start(port)
    wire.detach(port)
    assert wire.next_event_ns() == NEVER
    wire.run(10_000)
    assert sleeper.woken == []


def test_the_frame_a_node_was_sending_when_cut_off_still_ends():
    listener = Talker("listener")
    wire = Wire(1_000_000)
    ports = [wire.attach(node) for node in (Talker("sender", [(0, QUIET), (0, QUIET)]), listener)]
    for port in ports:
        wire.start(port)
    wire.run(10_000)
    wire.detach(ports[0])
    wire.run(1_000_000)
    assert listener.heard == [((BITS_0X123 - 3) * BIT_NS, QUIET)]


def test_a_name_is_unique_while_its_node_is_there():
    wire = Wire(1_000_000)
    port = wire.attach(Talker("controller"))
    with pytest.raises(ValueError, match="controller"):
        wire.attach(Talker("controller"))
    wire.detach(port)
    wire.attach(Talker("controller"))


def test_a_node_that_comes_later_hears_from_then_on():
    wire = wire_of(Talker("sender", [(0, QUIET), (0, QUIET)]))
    wire.run((BITS_0X123 - 3) * BIT_NS + 1)
    newcomer = Talker("newcomer")
    wire.start(wire.attach(newcomer))
    wire.run(1_000_000)
    assert newcomer.heard == [((2 * BITS_0X123 - 3) * BIT_NS, QUIET)]


# bookkeeping


def test_the_next_event_is_foretold():
    wire = wire_of()
    assert wire.next_event_ns() == NEVER
    wire = wire_of(Talker("sender", [(5_000, QUIET), (2_000, QUIET)], timer_ns=1_000), Talker("other"))
    foretold = []
    for _ in range(8):
        foretold.append(wire.next_event_ns())
        if foretold[-1] == NEVER:
            break
        wire.run(foretold[-1] + 1)
    first_end_ns = 2_000 + (BITS_0X123 - 3) * BIT_NS
    assert foretold == [
        1_000,
        2_000,
        first_end_ns,
        first_end_ns + 3 * BIT_NS,
        first_end_ns + BITS_0X123 * BIT_NS,
        NEVER,
    ]


def test_an_event_at_the_end_of_a_run_belongs_to_the_next_run():
    sleeper = Talker("sleeper", timer_ns=5_000)
    wire = wire_of(sleeper)
    wire.run(5_000)
    assert (sleeper.woken, wire.now_ns) == ([], 5_000)
    wire.run(5_001)
    assert sleeper.woken == [5_000]


# against a simulator that goes bit by bit


@dataclass(frozen=True)
class Plan:
    """What a `Planned` node does: one entry per wake-up, and an answer to each id it is to answer."""

    phase: int
    accepts: frozenset[int] | None
    wakes: list[tuple[int, list[tuple[int, Frame]]]]  # bits to the next wake-up; bits to the hand-over, frame
    answers: dict[int, tuple[int | None, int, Frame]]  # bits to the next wake-up, to the hand-over, frame


@dataclass
class Planned:
    """A node that follows a plan; all its times are whole bit times."""

    name: str
    plan: Plan
    heard: list[tuple[int, Frame]] = field(default_factory=list)
    woken: list[int] = field(default_factory=list)
    latched = transmits = frozenset()

    def __post_init__(self) -> None:
        self.accepts = self.plan.accepts
        self._wakes = iter(self.plan.wakes)

    def on_start(self, now_ns: int) -> Actions:
        return Actions(now_ns)

    def on_timer(self, now_ns: int) -> Actions:
        self.woken.append(now_ns)
        step = next(self._wakes, None)
        if step is None:
            return NOTHING
        wait, sends = step
        return Actions(
            now_ns + wait * BIT_NS, tuple((now_ns + delay * BIT_NS, frame) for delay, frame in sends)
        )

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        self.heard.append((now_ns, frame))
        answer = self.plan.answers.get(frame.can_id)
        if answer is None:
            return NOTHING
        wait, delay, reply = answer
        wake_ns = None if wait is None else now_ns + wait * BIT_NS
        return Actions(wake_ns, ((now_ns + delay * BIT_NS, reply),))


def bit_by_bit(nodes: list[Planned], out_of_band: frozenset[int], bits: int) -> list[tuple[int, Frame]]:
    """Simulate by looking, at every bit time, for what is due; return the traffic."""
    wake = dict.fromkeys(range(len(nodes)), None)
    handed_over, waiting, log = [], [], []
    on_wire, frame_end, idle_from = None, None, 0

    def do(number: int, actions: Actions, bit: int) -> None:
        offset = nodes[number].plan.phase
        if actions.wake_ns is not None:
            wake[number] = max(actions.wake_ns // BIT_NS + offset, bit)
        for send_ns, frame in actions.sends:
            handed_over.append((max(send_ns // BIT_NS + offset, bit), number, frame))

    def deliver(sender: int, frame: Frame, bit: int) -> None:
        log.append((bit * BIT_NS, frame))
        for number, node in enumerate(nodes):
            if number != sender and (node.accepts is None or frame.can_id in node.accepts):
                do(number, node.on_frame((bit - node.plan.phase) * BIT_NS, frame), bit)

    for number, node in enumerate(nodes):
        do(number, node.on_start(-node.plan.phase * BIT_NS), 0)
    for bit in range(bits):
        while True:
            due = [number for number, at in wake.items() if at == bit]
            ready = [entry for entry in handed_over if entry[0] == bit]
            if frame_end == bit:
                (sender, frame), frame_end = on_wire, None
                deliver(sender, frame, bit)
            elif due:
                wake[due[0]] = None
                do(due[0], nodes[due[0]].on_timer((bit - nodes[due[0]].plan.phase) * BIT_NS), bit)
            elif ready:
                handed_over.remove(ready[0])
                _, sender, frame = ready[0]
                if frame.can_id in out_of_band:
                    deliver(sender, frame, bit)
                else:
                    waiting.append((sender, frame))
            elif waiting and frame_end is None and bit >= idle_from:
                on_wire = min(waiting, key=lambda entry: (arbitration_field(entry[1].can_id), entry[0]))
                waiting.remove(on_wire)
                length = classic_bits(*on_wire[1])
                frame_end, idle_from = bit + length - 3, bit + length
            else:
                break
    return log


FEW_IDS = [0x000, 0x001, 0x100, 0x7FF, 0x100 << 18 | EFF_FLAG, 0x1FFF_FFFF | EFF_FLAG]
"""In the order of `min(FEW_IDS)` to `max(FEW_IDS)`; few, so that they meet."""


@st.composite
def frames(draw, above: int = -1):
    can_id = draw(st.sampled_from([i for i in FEW_IDS if i > above]))
    dlc = draw(st.integers(0, 8))
    return Frame(can_id, dlc, draw(st.integers(0, (1 << 8 * dlc) - 1)))


@st.composite
def plans(draw):
    delays = st.integers(0, 400)
    wakes = st.lists(
        st.tuples(st.integers(0, 300), st.lists(st.tuples(delays, frames()), max_size=3)), max_size=4
    )
    # an answer has a higher id than what it answers, so that no conversation goes on for ever
    answered = draw(st.sets(st.sampled_from(FEW_IDS[:-1]), max_size=2))
    return Plan(
        phase=draw(st.sampled_from([0, 0, 1, 500])),
        accepts=draw(st.none() | st.frozensets(st.sampled_from(FEW_IDS))),
        wakes=draw(wakes),
        answers={
            can_id: (draw(st.none() | delays), draw(delays), draw(frames(above=can_id)))
            for can_id in answered
        },
    )


@settings(max_examples=150, deadline=None)
@given(
    plans=st.lists(plans(), min_size=1, max_size=4),
    out_of_band=st.frozensets(st.sampled_from(FEW_IDS), max_size=2),
    slices=st.lists(st.integers(1, 900_000), max_size=5),
)
def test_the_wire_does_what_a_bit_by_bit_simulation_does(plans, out_of_band, slices):
    bits = 4000
    expected = [Planned(f"node {number}", plan) for number, plan in enumerate(plans)]
    log = bit_by_bit(expected, out_of_band, bits)

    nodes = [Planned(f"node {number}", plan) for number, plan in enumerate(plans)]
    wire = Wire(1_000_000, out_of_band)
    for port in [wire.attach(node, Clock(node.plan.phase * BIT_NS)) for node in nodes]:
        wire.start(port)
    for slice_ns in slices:
        wire.run(min(wire.now_ns + slice_ns, bits * BIT_NS))
    wire.run(bits * BIT_NS)

    assert traffic(wire) == log
    assert [node.heard for node in nodes] == [node.heard for node in expected]
    assert [node.woken for node in nodes] == [node.woken for node in expected]
