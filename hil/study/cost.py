"""What the firmware costs on its processors: instructions counted, cycles estimated, memory measured."""

import itertools
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from firmware_py.calibration import Calibration
from firmware_py.emulated.build import build, compiler_version
from firmware_py.emulated.cycles import Cost
from firmware_py.emulated.image import MANIFEST, Image, reference_image
from firmware_py.emulated.machine import Machine
from firmware_py.emulated.meter import Meter, StepMeter
from firmware_py.emulated.processors import TARGETS
from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS
from hil.closed_loop import play_closed_loop
from hil.references import setpoint_counts
from hil.scenario import load_scenario

CONTROLLERS = {
    "P": ("paper", k.LAW_P),
    "PI": ("paper", k.LAW_PI),
    "PI+FF": ("pi_ff", k.LAW_PI_FF),
    "ADRC": ("paper", k.LAW_ADRC),
    "robust ADRC": ("robust", k.LAW_SCHEDULED),
}
"""Name, tuning and control law of what is compared."""

BUILDS = (("zig", "-O2"), ("gcc", "-O2"), ("gcc", "-Os"))
"""Compilers and options that are compared; clang strips its symbols with -Os."""

SCENARIO = "sine"
JUMPS = 1000
JUMPS_SEED = 20261124

Inputs = list[tuple[int, int]]
"""Setpoint (0.1 um) and position (um) of each period."""


def calibration_of(controller: str) -> Calibration:
    """Return what a controller is calibrated with, its law the default one."""
    tuning, law = CONTROLLERS[controller]
    return replace(TUNINGS[tuning].calibration(), law=law)


def sine_inputs(controller: str, periods: int) -> Inputs:
    """Return what the controller is fed in the closed loop."""
    scenario, calibration = load_scenario(SCENARIO), calibration_of(controller)
    run = play_closed_loop(scenario, calibration)
    positions = np.floor(run.position_m * 1e6 + 0.5).astype(int)
    setpoints = setpoint_counts(scenario.reference_m())
    return list(zip(setpoints.tolist()[:periods], positions.tolist()[:periods], strict=True))


def jump_inputs(count: int = JUMPS) -> Inputs:
    """Return setpoints and positions anywhere on the stroke, so that no linear zone saves a power."""
    rng = np.random.default_rng(JUMPS_SEED)
    setpoints, positions = rng.integers(0, 4_000_000, count), rng.integers(0, 400_000, count)
    return list(zip(setpoints.tolist(), positions.tolist(), strict=True))


def step_costs(processor: str, image: Image, controller: str, inputs: Inputs) -> list[Cost]:
    """Return the cost of the control law alone, step by step."""
    machine = Machine(processor, image)
    machine.count_costs()
    meter = StepMeter(machine, calibration_of(controller), inputs[0][1])
    return [meter.step(*step) for step in inputs]


def summary(costs: Iterable[Cost], inputs: Inputs) -> dict[str, Any]:
    """Return mean and worst of some costs, and the inputs that caused the worst."""
    table = np.array(list(costs))
    worst = int(table[:, 2].argmax())
    mean = table.mean(axis=0)
    return {
        "mean_instructions": round(float(mean[0]), 1),
        "mean_cycles": [round(float(mean[1]), 1), round(float(mean[2]), 1)],
        "worst_instructions": int(table[:, 0].max()),
        "worst_cycles": [int(table[:, 1].max()), int(table[worst, 2])],
        "worst_period": worst,
        "worst_setpoint_0p1um": inputs[worst][0],
        "worst_position_um": inputs[worst][1],
    }


def controller_bill(processor: str, image: Image, controller: str, periods: int) -> dict[str, Any]:
    """Return what a controller costs: the law alone, and the interrupts with everything in them."""
    sine, jumps = sine_inputs(controller, periods), jump_inputs()
    meter = Meter(processor, image, calibration_of(controller), sine[0][1])
    metered = {
        name: [meter.period(*step) for step in inputs] for name, inputs in (("sine", sine), ("jumps", jumps))
    }
    return {
        "step": {
            "sine": summary(step_costs(processor, image, controller, sine), sine),
            "jumps": summary(step_costs(processor, image, controller, jumps), jumps),
        },
        "timer": {
            "sine": summary((one.timer for one in metered["sine"]), sine),
            "jumps": summary((one.timer for one in metered["jumps"]), jumps),
        },
        "receive": summary((one.receive for one in metered["sine"]), sine),
        "stack_bytes": meter.stack_bytes,
    }


def bill(periods: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Return the bill of the reference images.

    Parameters
    ----------
    periods : int
        How much of the sine is played.
    progress : callable
        Told what is being measured.
    """
    manifest = json.loads(MANIFEST.read_text())
    processors: dict[str, Any] = {}
    for processor, target in TARGETS.items():
        image = reference_image(processor)
        controllers = {}
        for controller in CONTROLLERS:
            progress(f"{processor}, {controller}")
            controllers[controller] = controller_bill(processor, image, controller, periods)
        worst = [
            one["timer"][name]["worst_cycles"][1]
            for one in controllers.values()
            for name in ("sine", "jumps")
        ]
        processors[processor] = {
            "clock_mhz": target.clock_mhz,
            "worst_period_cycles": max(worst),
            "flash_bytes": image.flash_bytes,
            "ram_bytes": image.ram_bytes,
            "stack_bytes": max(one["stack_bytes"] for one in controllers.values()),
            "image_sha256": manifest["images"][processor]["sha256"],
            "controllers": controllers,
        }
    return {"compiler": manifest["compiler"], "periods": periods, "processors": processors}


def compiler_names() -> dict[tuple[str, str, str], str]:
    """Return name, version and option of each compiler, by compiler, option and processor.

    Raises
    ------
    BuildError
        If one is not installed.
    """
    return {
        (compiler, optimisation, processor): f"{compiler_version(compiler, processor)} {optimisation}"
        for (compiler, optimisation), processor in itertools.product(BUILDS, TARGETS)
    }


def compilers_bill(
    names: Mapping[tuple[str, str, str], str], periods: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Return what ADRC costs as built by each compiler; see `compiler_names`, and `bill` for the others."""
    sine, jumps = sine_inputs("ADRC", periods), jump_inputs()
    built: dict[str, Any] = {}
    for (compiler, optimisation, processor), name in names.items():
        progress(f"{processor}, {name}")
        image = build(compiler, processor, optimisation)
        built.setdefault(name, {})[processor] = {
            "sine": summary(step_costs(processor, image, "ADRC", sine), sine),
            "jumps": summary(step_costs(processor, image, "ADRC", jumps), jumps),
            "flash_bytes": image.flash_bytes,
        }
    return built
