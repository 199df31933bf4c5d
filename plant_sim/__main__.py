"""``python -m plant_sim``: drive, sensors and simulated machine as a process of its own on a bus."""

import argparse
import sys

import hil.bus.mf4_on_demand  # noqa: F401  before python-can is imported
from dbc.contract import Contract
from hil.bus.wire import Clock
from hil.run.node_process import add_node_arguments, node_main
from plant_sim.machine import Machine
from plant_sim.node import Plant

DESCRIPTION = "Drive, sensors and simulated machine as a process of its own on a bus."


def main(argv: list[str] | None = None) -> int:
    """Run the plant until it is stopped."""
    parser = argparse.ArgumentParser(prog="python -m plant_sim", description=DESCRIPTION)
    add_node_arguments(parser)
    parser.add_argument("--machine", metavar="KEY=VALUE,...", help="differing machine: mass=1.5,leak=2 ...")
    parser.add_argument(
        "--noise-um", type=float, default=0.0, metavar="UM", help="position noise, µm RMS (default 0)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the noise (default 0)")

    def build(arguments: argparse.Namespace) -> Plant:
        machine = Machine().with_text(arguments.machine) if arguments.machine is not None else Machine()
        sensor = machine.sensor(arguments.noise_um * 1e-6, arguments.seed)
        return Plant(Contract.load(arguments.dbc), machine.parameters, sensor, machine.delay_periods)

    return node_main(parser, build, Clock(), argv)


if __name__ == "__main__":
    sys.exit(main())
