"""A controller on the bus with plant and supervisor."""

from typing import Any

import numpy as np
from firmware_events import CONTRACT

from dbc.node import PERIOD_NS
from hil.bus.wire import Wire
from hil.run.inprocess import CLOCKS
from hil.scenario import Scenario
from hil.supervisor import BRING_UP_PERIODS, Supervisor
from plant_sim.node import Plant
from plant_sim.parameters import NOMINAL


def traffic_under(controller: Any, scenario: Scenario) -> np.ndarray:
    """All frames of a scenario's run, with their times."""
    wire = Wire(1_000_000, frozenset({CONTRACT.bench_control.can_id}))
    supervisor = Supervisor(CONTRACT, "scheduled", scenario.initial_m)
    nodes = [supervisor, Plant(CONTRACT, NOMINAL), controller]
    for port in [wire.attach(node, CLOCKS[node.name]) for node in nodes]:
        wire.start(port)
    supervisor.plan_scenario(scenario)
    wire.run((BRING_UP_PERIODS + scenario.periods) * PERIOD_NS)
    return wire.traffic
