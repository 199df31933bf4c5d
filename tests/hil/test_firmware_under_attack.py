"""The firmware hears frames that nobody should send, and does nothing it should not do.

The oracle knows the bus and bitwise CRCs only: nothing of mailboxes, counters or the state machine.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dbc import e2e
from dbc.contract import Contract
from dbc.frame import EFF_FLAG, Frame
from dbc.node import PERIOD_NS
from firmware_py.diagnosis import State
from firmware_py.node import PHASE_NS
from hil.bench import RECOVERY_STEPS
from hil.bus.wire import FrameFault
from hil.bus.wire_core import MAX_PORTS
from hil.run.inprocess import InprocessRig
from hil.run.options import RigOptions
from hil.supervisor import BRING_UP_PERIODS

CONTRACT = Contract.load()
PROTECTED = (
    CONTRACT.position_feedback,
    CONTRACT.position_setpoint,
    CONTRACT.controller_command,
    CONTRACT.drive_status,
    CONTRACT.drive_command,
)
BENCH_IDS = {CONTRACT.bench_control.can_id, CONTRACT.bench_load.can_id}
HIGHEST_COUNT = 3000 * 4  # the drive's 3000 rpm in 0.25 rpm
HIGHEST_RAD_S = 100 * np.pi
STANDSTILL_RAD_S = 1.0
COASTING_PERIODS = 3 + 95  # missed commands, then the ramp and the motor's lag behind it
PLANT, CONTROLLER = 1, 2  # ports on the wire
CONTROLWORDS = {0x00, 0x02, 0x06, 0x07, 0x0F, 0x80}
OPERATION_ENABLED = 0x27
SLICE_PERIODS = 20
ATTACKER = MAX_PORTS
MEMORY = 60


class Attacker:
    """Sends random, mutated, replayed and forged frames; all it knows is the contract and what it hears."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._attacks = (self.random, self.mutated, self.replayed, self.forged, self.mistaken)

    def frames(self, heard: list[Frame], count: int) -> list[Frame]:
        """Return the next `count` frames; `heard` are the newest on the bus."""
        frames: list[Frame] = []
        while len(frames) < count:
            if self._rng.random() < 0.05:
                frames += self.reordered(heard)
            else:
                frames.append(self._attacks[int(self._rng.integers(len(self._attacks)))](heard))
        return frames[:count]

    def random(self, heard: list[Frame]) -> Frame:
        dlc = int(self._rng.integers(9))
        known = [message.can_id for message in CONTRACT.messages if message.can_id not in BENCH_IDS]
        kind = self._rng.random()
        can_id = int(self._rng.choice(known))
        if kind < 0.2:
            can_id = int(self._rng.integers(0x800))
        elif kind < 0.3:
            can_id = EFF_FLAG | int(self._rng.integers(1 << 28))
        return Frame(can_id, dlc, int.from_bytes(self._rng.bytes(dlc)))

    def mutated(self, heard: list[Frame]) -> Frame:
        can_id, dlc, data = self.replayed(heard)
        for _ in range(int(self._rng.integers(1, 4))):
            data ^= 1 << int(self._rng.integers(max(8 * dlc, 1))) if dlc else 0
        return Frame(can_id, dlc, data)

    def replayed(self, heard: list[Frame]) -> Frame:
        return heard[int(self._rng.integers(len(heard)))]

    def reordered(self, heard: list[Frame]) -> list[Frame]:
        """Return the newest frames of one message in another order."""
        can_id = self.replayed(heard).can_id
        newest = [frame for frame in heard if frame.can_id == can_id][-4:]
        return [newest[place] for place in self._rng.permutation(len(newest))]

    def mistaken(self, heard: list[Frame]) -> Frame:
        """Return a forged frame of another length, or whose identifier only looks like that of a message."""
        can_id, dlc, data = self.forged(heard)
        if self._rng.random() < 0.5:
            return Frame(EFF_FLAG | can_id << int(self._rng.choice([0, 18])), dlc, data)
        other = int(self._rng.choice([length for length in range(9) if length != dlc]))
        return Frame(can_id, other, data & (1 << 8 * other) - 1)

    def forged(self, heard: list[Frame]) -> Frame:
        """Return a frame whose CRC is right: nothing but its content and counter can give it away."""
        message = PROTECTED[int(self._rng.integers(len(PROTECTED)))]
        data = int.from_bytes(self._rng.bytes(message.dlc), "little")
        if self._rng.random() < 0.5:  # extreme fields
            data = int(self._rng.choice([0, 0xFFFF, 0x8000, 0x7FFF])) << 16 | data & 0xFFFF
            data &= (1 << 8 * message.dlc) - 1
        counter = data >> 8 & 0xF
        data = data >> 8 << 8 | int(e2e.profile2_crc(data, message.dlc, message.data_ids[counter]))
        return Frame(message.can_id, message.dlc, data)


def intact(traffic: np.ndarray, message) -> np.ndarray:
    """Return the rows of a log that carry a message with the right length and CRC, found bit by bit."""
    rows = traffic[(traffic[:, 1] == message.can_id) & (traffic[:, 2] == message.dlc)]
    data = rows[:, 3]
    counter = (data >> np.uint64(8) & np.uint64(0xF)).astype(int)
    crc = np.full(len(rows), 0xFF)
    content = [data >> np.uint64(8 * n) & np.uint64(0xFF) for n in range(1, message.dlc)]
    for byte in (*content, np.array(message.data_ids)[counter]):
        crc ^= byte.astype(int)
        for _ in range(8):
            crc = np.where(crc & 0x80, crc << 1 ^ 0x2F, crc << 1) & 0xFF
    return rows[crc ^ 0xFF == (data & np.uint64(0xFF)).astype(int)]


def newest_before(times_ns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the time of the newest row at or before each time; far in the past where there is none."""
    stamps = np.concatenate([[-(10**15)], rows[:, 0].astype(np.int64)])
    return stamps[np.searchsorted(stamps, times_ns, side="right") - 1]


def sent_by(port: int, message, log: np.ndarray) -> list:
    """Return what a node put on the bus of a message."""
    own = log[(log[:, 1] & 0xFFFF_FFFF == message.can_id) & (log[:, 3] == port)]
    return [message.unpack(int(data) & (1 << 64) - 1) for data in own[:, 2]]


def attacked_run(tmp_path: Path, seed: int, count: int, enabled: bool):
    """Return recording and log of a run with `count` hostile frames in bursts; own ones get lost."""
    attacker, rng, left = Attacker(seed), np.random.default_rng(seed + 1), count
    with InprocessRig(RigOptions(record_directory=tmp_path)) as rig:
        session = rig.begin("adrc", 0.15)
        supervisor, wire = session.supervisor, session.wire
        supervisor.plan(BRING_UP_PERIODS, reference=lambda t: 0.15 + 0.05 * np.sin(2 * np.pi * 0.5 * t))
        if not enabled:
            supervisor.plan(0, enable=0)
            for period in (20, 24, 28, 32):
                supervisor.plan(period, enable=0)
        period = BRING_UP_PERIODS
        session.run_to(period)
        while left:
            newest = wire.log[-MEMORY:]
            heard = [Frame(head & 0xFFFF_FFFF, head >> 32, data) for _, head, data, _ in newest.tolist()]
            heard = [
                Frame(f.can_id, f.dlc, f.data & (1 << 64) - 1) for f in heard if f.can_id not in BENCH_IDS
            ]
            burst = min(left, int(rng.integers(1, 6)) * SLICE_PERIODS) if rng.random() < 0.3 else 0
            at_ns = np.sort(rng.integers(0, SLICE_PERIODS * PERIOD_NS, burst)).tolist()
            for ready_ns, frame in zip(at_ns, attacker.frames(heard, burst), strict=True):
                wire.send(ATTACKER, wire.now_ns + ready_ns, frame)
            left -= burst
            if rng.random() < 0.05:
                victim = PROTECTED[int(rng.integers(len(PROTECTED)))]
                wire.spoil(victim.can_id, FrameFault.DROP, 0, int(rng.integers(1, 9)))
            if rng.random() < 0.05:  # overtaken by the next one of its kind
                victim = PROTECTED[int(rng.integers(len(PROTECTED)))]
                delay_ns = max(victim.cycle_time_ns, PERIOD_NS) * 5 // 4
                wire.spoil(victim.can_id, FrameFault.DELAY, delay_ns, 1)
            if enabled and rng.random() < 0.1:
                for after, words in (*RECOVERY_STEPS, (70, {"enable": 1})):
                    supervisor.plan(period + after, **words)
            period += SLICE_PERIODS
            session.run_to(period)
        session.run_to(period + 100)
        return session.recording(), wire.log.copy()


def check(recording, log: np.ndarray) -> dict[str, int]:
    """Judge a run; return how many periods the controller moved and was in its safe state."""
    commands = sent_by(CONTROLLER, CONTRACT.drive_command, log)
    assert {command.controlword for command in commands} <= CONTROLWORDS
    assert max(abs(command.target_velocity) for command in commands) <= HIGHEST_COUNT
    reports = sent_by(PLANT, CONTRACT.drive_status, log)
    assert max(abs(report.actual_velocity) for report in reports) <= HIGHEST_COUNT

    controller = recording.controller
    timer_ns = controller["time_ns"] + PHASE_NS
    velocity = controller["target_velocity_0p25rpm"]
    assert np.abs(velocity).max() <= HIGHEST_COUNT
    moving = timer_ns[velocity != 0]
    status = intact(recording.traffic, CONTRACT.drive_status)
    command = intact(recording.traffic, CONTRACT.controller_command)
    needed = (  # evidence, and within how many periods it must have come
        (intact(recording.traffic, CONTRACT.position_feedback), 3),
        (intact(recording.traffic, CONTRACT.position_setpoint), 3),
        (command[command[:, 3] >> np.uint64(16) & np.uint64(1) == 1], 300),
        (status[status[:, 3] >> np.uint64(16) & np.uint64(0x6F) == OPERATION_ENABLED], 30),
    )
    for rows, periods in needed:
        unjustified = moving[moving - newest_before(moving, rows) > periods * PERIOD_NS]
        assert not unjustified.size, unjustified[:5]
    state = controller["state"]
    starts = np.flatnonzero((state[1:] == State.RUN) & (state[:-1] != State.RUN)) + 1
    unready = timer_ns[(state != State.RUN) & (state != State.STANDBY)]
    withdrawn = command[command[:, 3] >> np.uint64(16) & np.uint64(1) == 0]
    last_unready = np.append(0, unready)[np.searchsorted(unready, timer_ns[starts])]
    unarmed = starts[newest_before(timer_ns[starts], withdrawn) < last_unready]
    assert not unarmed.size, unarmed[:5]
    speed_rad_s = np.abs(recording.plant["motor_speed_rad_s"])
    assert speed_rad_s.max() <= HIGHEST_RAD_S * (1 + 1e-9)
    turning = (recording.plant["time_ns"][speed_rad_s > STANDSTILL_RAD_S]).astype(np.int64)
    ordered = intact(recording.traffic, CONTRACT.drive_command)
    enabling = ordered[ordered[:, 3] >> np.uint64(16) & np.uint64(0x8F) == 0x0F]
    unordered = turning[turning - newest_before(turning, enabling) > COASTING_PERIODS * PERIOD_NS]
    assert not unordered.size, unordered[:5]
    assert np.isfinite(recording.plant["position_m"]).all()
    assert -1e-3 < recording.plant["position_m"].min() <= recording.plant["position_m"].max() < 0.401
    return {"moving": len(moving), "safe": int((controller["state"] == State.SAFE).sum())}


def test_the_oracle_knows_intact_frames_from_others():
    good = np.array([(0, *Attacker(1).forged([])) for _ in range(1)], np.uint64)
    message = next(m for m in PROTECTED if m.can_id == good[0, 1])
    bad = good ^ np.array([[0, 0, 0, 1 << 17]], np.uint64)
    assert (len(intact(good, message)), len(intact(bad, message))) == (1, 0)


@pytest.mark.parametrize("enabled", [True, False], ids=["enabled", "never_enabled"])
def test_a_hundred_thousand_hostile_frames(tmp_path, enabled):
    seen = check(*attacked_run(tmp_path, 5, 50_000, enabled))
    assert seen["safe"] > 1000, "the attack must be felt"
    assert (seen["moving"] > 1000) or not enabled, "the machine must have something to lose"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_a_million_hostile_frames(tmp_path, seed):
    for part in range(10):
        check(*attacked_run(tmp_path, 1000 + 10 * seed + part, 25_000, enabled=part % 2 == 0))


def test_the_same_seed_is_the_same_attack(tmp_path):
    one, other = (attacked_run(tmp_path, 7, 500, enabled=True)[0].traffic for _ in range(2))
    assert np.array_equal(one, other)


def doctored(recording, side: str, column: str, row: int, value: float):
    columns = {name: values.copy() for name, values in getattr(recording, side).items()}
    columns[column][row] = value
    return replace(recording, **{side: columns})


@pytest.mark.parametrize(
    ("side", "column", "value"),
    [
        ("controller", "target_velocity_0p25rpm", 4),  # without an enable
        ("controller", "target_velocity_0p25rpm", 12_001),
        ("plant", "motor_speed_rad_s", 2.0),  # without a command that enables
        ("plant", "position_m", 0.402),
        ("plant", "position_m", np.nan),
    ],
)
def test_the_oracle_sees_a_single_period_that_must_not_be(quiet_run, side, column, value):
    recording, log = quiet_run
    check(recording, log)
    with pytest.raises(AssertionError):
        check(doctored(recording, side, column, 200, value), log)


@pytest.mark.parametrize("bits", [12_001 << 32, 0x10 << 16])
def test_the_oracle_sees_a_single_frame_that_must_not_be(quiet_run, bits):
    recording, log = quiet_run
    log = log.copy()
    (first, *_) = np.flatnonzero(log[:, 1] & 0xFFFF_FFFF == CONTRACT.drive_command.can_id)
    log[first, 2] = bits
    with pytest.raises(AssertionError):
        check(recording, log)


@pytest.fixture(scope="module")
def quiet_run(tmp_path_factory):
    """A short attack on a machine that nobody enables."""
    return attacked_run(tmp_path_factory.mktemp("quiet"), 3, 200, enabled=False)
