"""``python -m plant_sim``: drive, sensors and simulated machine as a process of its own on a bus."""

import argparse
import sys

from dbc.contract import Contract
from hil.bus.wire import Clock
from hil.run.node_process import add_node_arguments, node_main
from plant_sim.node import Plant
from plant_sim.parameters import PlantParameters
from plant_sim.sensors import PositionSensor

DESCRIPTION = "Drive, sensors and simulated machine as a process of its own on a bus."


def main(argv: list[str] | None = None) -> int:
    """Run the plant until it is stopped."""
    parser = argparse.ArgumentParser(prog="python -m plant_sim", description=DESCRIPTION)
    add_node_arguments(parser)
    parser.add_argument(
        "--lsb-um", type=int, default=1, metavar="UM", help="position sensor resolution, µm (default 1)"
    )
    parser.add_argument(
        "--noise-um", type=float, default=0.0, metavar="UM", help="position noise, µm RMS (default 0)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the noise (default 0)")

    def build(arguments: argparse.Namespace) -> Plant:
        sensor = PositionSensor(arguments.lsb_um * 1e-6, arguments.noise_um * 1e-6, arguments.seed)
        return Plant(Contract.load(arguments.dbc), PlantParameters(), sensor)

    return node_main(parser, build, Clock(), argv)


if __name__ == "__main__":
    sys.exit(main())
