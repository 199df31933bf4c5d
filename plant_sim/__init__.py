"""The machine under control: hydraulics, crane, drive and sensors in SI floats."""

from plant_sim.drive import Drive, State
from plant_sim.equilibrium import initial_state
from plant_sim.integrator import advance
from plant_sim.open_loop import PlantTrace, simulate
from plant_sim.parameters import ParameterError, PlantParameters, PumpModel
from plant_sim.sensors import PositionSensor, pressure_count

__all__ = [
    "Drive",
    "ParameterError",
    "PlantParameters",
    "PlantTrace",
    "PositionSensor",
    "PumpModel",
    "State",
    "advance",
    "initial_state",
    "pressure_count",
    "simulate",
]
