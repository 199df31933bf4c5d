"""``python -m firmware_py``: the firmware emulator as a process of its own on a bus."""

import argparse
import sys

import hil.bus.mf4_on_demand  # noqa: F401  before python-can is imported
from dbc.contract import Contract
from firmware_py.chosen_firmware import add_firmware_argument, firmware_of_text
from firmware_py.chosen_tuning import add_tuning_arguments, tuning_of
from firmware_py.node import PHASE_NS, Controller
from hil.bus.wire import Clock
from hil.run.node_process import add_node_arguments, node_main

DESCRIPTION = "The firmware emulator as a process of its own on a bus."


def main(argv: list[str] | None = None) -> int:
    """Run the controller until it is stopped."""
    parser = argparse.ArgumentParser(prog="python -m firmware_py", description=DESCRIPTION)
    add_node_arguments(parser)
    add_tuning_arguments(parser)
    add_firmware_argument(parser)

    def build(arguments: argparse.Namespace) -> Controller:
        contract, calibration = Contract.load(arguments.dbc), tuning_of(arguments).calibration
        return firmware_of_text(arguments.firmware).controller(contract, calibration.to_bytes())

    return node_main(parser, build, Clock(PHASE_NS), argv)


if __name__ == "__main__":
    sys.exit(main())
