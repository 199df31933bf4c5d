"""Plant and firmware started by hand on a real vcan0: what other programs see of them, and what they outlive.

One pair of processes serves all tests of this file, in their order: the last one takes the interface away.
"""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event

import can
import numpy as np
import pytest
from guest_init import create_link, delete_link, set_link
from hand_started import (
    CHANNEL,
    COMMAND,
    CONTRACT,
    FEEDBACK,
    RT_RATIO,
    SAFETY_NET_S,
    Side,
    both_sides,
    hear_both,
    wait_for,
)

from dbc.contract import PACKAGED_DBC
from hil.bus.opening import open_bus
from hil.bus.socketcan import socketcan_status
from hil.bus.wire import Clock
from hil.run.realtime import RealtimeNode
from hil.scenario import load_scenario
from hil.supervisor import Supervisor
from plant_sim.drive import State as DriveState

STATUS = CONTRACT.controller_status.can_id
BACKGROUND = 0x6F0
"""Of lower priority than everything in the contract."""
RUN, SAFE = 2, 3
STALE_PERIODS = 3


@pytest.fixture(scope="module")
def sides(tmp_path_factory) -> Iterator[dict[str, Side]]:
    with both_sides(tmp_path_factory.mktemp("record")) as sides:
        yield sides


def hear_state(state: int) -> can.Message:
    """Wait until the controller reports a state, from now on."""
    with can.Bus(interface="socketcan", channel=CHANNEL) as bus:
        return wait_for(bus, lambda m: m.arbitration_id == STATUS and m.data[0] & 0xF == state)


def test_vcan_status_names_the_command_to_type():
    status = socketcan_status()
    assert status.usable
    assert status.line.endswith("type `hil run sine --mode realtime -i socketcan -c vcan0`")


# other programs


def test_candump_logs_both_sides_by_id(sides):
    dump = subprocess.run(["candump", "-L", "-n", "100", CHANNEL], capture_output=True, text=True)
    lines = re.findall(rf"^\(\d+\.\d{{6}}\) {CHANNEL} ([0-9A-F]{{3}})#([0-9A-F]*)$", dump.stdout, re.M)
    assert len(lines) == 100
    assert {(can_id, len(data) // 2) for can_id, data in lines} >= {("100", 6), ("110", 6), ("180", 6)}


def test_cantools_decodes_what_candump_prints_by_name(sides):
    command = f"candump -n 100 {CHANNEL} | {sys.executable} -m cantools decode -s {PACKAGED_DBC}"
    decoded = subprocess.run(["sh", "-c", command], capture_output=True, text=True).stdout
    assert re.search(r"100.*:: DriveCommand\(.*Controlword: \w+.*TargetVelocity: .* rpm", decoded)
    assert re.search(r"110.*:: PositionFeedback\(.*SensorStatus: Ok.*Position: .* m", decoded)


def test_cantools_monitor_shows_both_sides_by_name(sides):
    screen, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("4H", 200, 120, 0, 0))
    command = [sys.executable, "-m", "cantools", "monitor", "-s", "-i", "socketcan", "-c", CHANNEL]
    environment = os.environ | {"TERM": "linux"}
    monitor = subprocess.Popen(
        [*command, str(PACKAGED_DBC)], stdin=terminal, stdout=terminal, stderr=terminal, env=environment
    )
    os.close(terminal)
    seen = ""
    try:
        while not {"DriveCommand", "PositionFeedback", "DriveStatus"} <= set(re.findall(r"\w+", seen)):
            seen += os.read(screen, 65536).decode(errors="replace")
        os.write(screen, b"q")
        with suppress(OSError):  # reading fails once the other end is closed
            while os.read(screen, 65536):
                pass
        assert monitor.wait(SAFETY_NET_S) == 0
    finally:
        monitor.kill()
        monitor.wait()
        os.close(screen)


# other traffic


def test_the_kernels_periodic_frames_and_ours_share_the_bus_without_loss(sides):
    """The kernel sends numbered frames on its own clock; every stream is heard without a gap."""
    numbered = [
        can.Message(arbitration_id=BACKGROUND, data=[number], is_extended_id=False) for number in range(200)
    ]
    heard: dict[int, list[int]] = {BACKGROUND: [], COMMAND: [], FEEDBACK: []}
    with (
        can.Bus(interface="socketcan", channel=CHANNEL) as bus,
        can.Bus(interface="socketcan", channel=CHANNEL) as sender,
    ):
        sender.send_periodic(numbered, period=0.01)

        def enough(message: can.Message) -> bool:
            if message.arbitration_id in heard:
                data = message.data
                heard[message.arbitration_id].append(data[0] if len(data) == 1 else data[1] & 0xF)
            return all(len(numbers) >= 100 for numbers in heard.values())

        wait_for(bus, enough)
    assert_no_gap(heard[BACKGROUND], modulus=200)
    assert_no_gap(heard[COMMAND], modulus=16)
    assert_no_gap(heard[FEEDBACK], modulus=16)


def assert_no_gap(numbers: list[int], modulus: int) -> None:
    assert numbers == [(numbers[0] + count) % modulus for count in range(len(numbers))]


# an interface that comes and goes


@contextmanager
def supervised() -> Iterator[None]:
    """Reset both sides, enable the controller, and play a scenario that is longer than any test."""
    stopped = Event()
    supervisor = Supervisor(CONTRACT, "adrc")
    supervisor.plan_scenario(load_scenario("sine"))
    with open_bus("socketcan", CHANNEL, None) as bus, ThreadPoolExecutor() as executor:
        runner = RealtimeNode(supervisor, bus, RT_RATIO, Clock())
        runner.start()
        future = executor.submit(runner.run, lambda: not stopped.is_set())
        try:
            yield
        finally:
            stopped.set()
            future.result()


def node_time_ns() -> int:
    return time.monotonic_ns() * RT_RATIO.numerator // RT_RATIO.denominator


@pytest.fixture(scope="module")
def interruption(sides) -> tuple[int, int]:
    """Take the interface down for 20 periods while the controller runs; return begin and end in node time."""
    with supervised():
        hear_state(RUN)
        set_link(CHANNEL, up=False)
        begin_ns = node_time_ns()
        while node_time_ns() < begin_ns + 20 * 1_000_000:
            time.sleep(0.01)
        end_ns = node_time_ns()
        set_link(CHANNEL, up=True)
        hear_both()
    return begin_ns, end_ns


def test_both_sides_outlive_an_interface_that_goes_down_and_up(sides, interruption):
    deadline_s = time.monotonic() + SAFETY_NET_S
    for side in sides.values():
        while len(side.said()) < 3:
            assert time.monotonic() < deadline_s, side.said()
            time.sleep(0.01)
        assert side.process.poll() is None
        _, lost, back = side.said()
        assert lost == "socketcan channel 'vcan0': Network is down; frames are lost until it is back"
        frames = re.fullmatch(r"socketcan channel 'vcan0': back, (\d+) frames could not be sent", back)
        assert frames
        assert int(frames[1]) > 0


def test_the_controller_is_in_its_safe_state_after_it(sides, interruption):
    hear_state(SAFE)


def test_started_anew_the_controller_runs_again(sides, interruption):
    with supervised():
        hear_state(RUN)


def test_an_interface_that_is_removed_ends_both_with_one_line_and_their_whole_record(sides, interruption):
    seen = {name: len(side.said()) for name, side in sides.items()}
    try:
        delete_link(CHANNEL)
        for name, side in sides.items():
            assert side.process.wait(SAFETY_NET_S) == 3
            (line,) = side.said()[seen[name] :]
            assert line.endswith("is gone: plug the adapter in again, or see `hil vcan status`")
    finally:
        create_link(CHANNEL, "vcan")
        set_link(CHANNEL, up=True)
    controller, plant = (load(sides[name].record, interruption) for name in ("controller", "plant"))
    down_periods = (interruption[1] - interruption[0]) // 1_000_000
    for record in (controller, plant):
        assert len(record["time_ns"]) >= down_periods / 2, "inconclusive: the machine stalled"
    assert (controller["state"][STALE_PERIODS + 1 :] == SAFE).all()
    assert (controller["target_velocity_0p25rpm"][STALE_PERIODS + 1 :] == 0).all()
    stopping = {DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT}
    assert set(plant["drive_state"][STALE_PERIODS + 1 :]) <= stopping


def load(file: Path, interruption: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return what a side recorded while the interface was down."""
    with np.load(file) as columns:
        time_ns = columns["time_ns"]
        down = (time_ns > interruption[0]) & (time_ns < interruption[1])
        return {name: columns[name][down] for name in columns}
