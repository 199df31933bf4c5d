"""What a firmware's interrupts are given: an honest bus, with every kind of damage mixed in."""

import random
from collections.abc import Iterator
from typing import NamedTuple

from dbc.contract import Contract
from dbc.frame import Frame

CONTRACT = Contract.load()
POWER_ON, FRAME, TIMER = range(3)
DRIVE_STATES = 0x250, 0x231, 0x233, 0x217, 0x21F, 0x218, 0


class Event(NamedTuple):
    """An interrupt; a frame for `FRAME`."""

    kind: int
    frame: Frame = Frame(0, 0, 0)


class Senders:
    """All that talks to the controller, each frame with the next counter."""

    def __init__(self) -> None:
        self.codecs = {
            "feedback": CONTRACT.position_feedback,
            "setpoint": CONTRACT.position_setpoint,
            "command": CONTRACT.controller_command,
            "drive_status": CONTRACT.drive_status,
        }
        self._protectors = {name: codec.protector() for name, codec in self.codecs.items()}

    def frame(self, name: str, *values: int) -> Frame:
        codec = self.codecs[name]
        return codec.frame(self._protectors[name].protect(codec.pack(*values)))


def spoiled(rng: random.Random, frame: Frame) -> list[Frame]:
    """A frame lost, corrupt, of a wrong length, twice, or made of noise."""
    match rng.randrange(5):
        case 0:
            return []
        case 1:
            return [frame._replace(data=frame.data ^ 1 << rng.randrange(8 * frame.dlc))]
        case 2:
            return [frame._replace(dlc=rng.randint(0, 8))]
        case 3:
            return [frame, frame]
    return [frame._replace(dlc=rng.randint(0, 8), data=rng.getrandbits(64))]


def fuzzed(seed: int, periods: int) -> Iterator[Event]:
    """Yield periods of an eventful life: enabled, spoilt, lost, reset, out of range, recovered."""
    rng, senders = random.Random(seed), Senders()
    position_um, setpoint, enable, law, fault_reset, statusword, rate = (
        100_000,
        1_000_000,
        0,
        3,
        0,
        0x1237,
        0.0,
    )
    yield Event(POWER_ON)
    for period in range(periods):
        chance = rng.random
        enable = int(chance() < 0.75) if chance() < 0.02 else enable
        law = rng.randint(0, 7) if chance() < 0.01 else law
        fault_reset = rng.randint(0, 1) if chance() < 0.05 else fault_reset
        if chance() < 0.01:
            statusword = rng.choice(
                [*9 * [0x1237], 0x250, 0x231, 0x233, 0x217, 0x21F, 0x218, 0, rng.getrandbits(16)]
            )
        rate = rng.choice([0.0, 0.0, 0.1, 0.6]) if chance() < 0.02 else rate
        position_um += rng.randint(-100, 100)
        setpoint += rng.randint(-1000, 1000)
        far = chance() < 0.002
        due = {
            "feedback": (
                rng.choice([*200 * [0], 1, 2, 3, 15]),
                rng.choice([-10_001, 410_001]) if far else position_um,
            ),
            "setpoint": (rng.choice([-10_001, 4_010_001]) if far else setpoint,),
        }
        if period % 100 == 0 or chance() < 0.1:
            due["command"] = enable, law, fault_reset
        if period % 10 == 0:
            due["drive_status"] = statusword, rng.randint(-4000, 4000)
        for name, values in due.items():
            frame = senders.frame(name, *values)
            for sent in spoiled(rng, frame) if chance() < rate else [frame]:
                yield Event(FRAME, sent)
        if chance() < 0.001:
            bench = CONTRACT.bench_control
            yield Event(FRAME, bench.frame(bench.pack(rng.randint(0, 3), 0, 5)))
        if chance() < 0.0005:
            yield Event(POWER_ON)
        yield Event(TIMER)
