"""Plant and firmware on the guest's vcan0, started as a user would, for the tests of this folder."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import can

from dbc.contract import Contract

CHANNEL = "vcan0"
RT_RATIO = Fraction(1, 50)
"""A period is 50 ms of wall time: three missed ones are longer than this kind of guest stalls."""
SAFETY_NET_S = 300.0
CONTRACT = Contract.load()
COMMAND, FEEDBACK = CONTRACT.drive_command.can_id, CONTRACT.position_feedback.can_id


class Side:
    """A node process."""

    def __init__(self, module: str, name: str, folder: Path) -> None:
        self.record = folder / f"{name}.npz"
        self.stderr = folder / f"{name}.stderr"
        command = [sys.executable, "-m", module, "-i", "socketcan", "-c", CHANNEL]
        command += ["--rt-ratio", str(RT_RATIO), "--record", str(folder)]
        with open(self.stderr, "w") as stderr:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=stderr)

    def said(self) -> list[str]:
        return self.stderr.read_text().splitlines()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def both_sides(folder: Path) -> Iterator[dict[str, Side]]:
    """Start both, wait until they are heard, and make sure that they end."""
    sides = {"plant": Side("plant_sim", "plant", folder)}
    try:
        sides["controller"] = Side("firmware_py", "controller", folder)
        hear_both()
        yield sides
    finally:
        for side in sides.values():
            side.kill()
            print(*side.said(), sep="\n")


def wait_for(bus: can.BusABC, what: Callable[[can.Message], bool]) -> can.Message:
    deadline_s = time.monotonic() + SAFETY_NET_S
    while (message := bus.recv(1.0)) is None or not what(message):
        assert time.monotonic() < deadline_s, "waited in vain"
    return message


def hear_both() -> None:
    """Wait until both sides are heard, from now on."""
    with can.Bus(interface="socketcan", channel=CHANNEL) as bus:
        for can_id in (COMMAND, FEEDBACK):
            wait_for(bus, lambda message, can_id=can_id: message.arbitration_id == can_id)
