"""One period of drive and plant, compiled."""

import numpy as np

from dbc import e2e
from dbc.jit import njit
from dbc.node import PERIOD_NS
from dbc.profile2 import CONFIGURATION_SIZE
from plant_sim import layout as at
from plant_sim.drive import STATE, drive_step
from plant_sim.hydraulics import accumulator_pressure
from plant_sim.integrator import advance
from plant_sim.sensors import IS_SILENT, STATUS, reported_um

SUBSTEPS = 10
PERIOD_S = PERIOD_NS * 1e-9

COLUMNS = (
    "time_ns",
    "position_m",
    "velocity_m_s",
    "pressure_a_pa",
    "pressure_b_pa",
    "pressure_accumulator_pa",
    "motor_speed_rad_s",
    "speed_command_rad_s",
    "load_n",
    "drive_state",
)
(
    TIME,
    POSITION,
    VELOCITY,
    PRESSURE_A,
    PRESSURE_B,
    PRESSURE_ACCUMULATOR,
    MOTOR_SPEED,
    SPEED_COMMAND,  # held by the drive until the next period
    LOAD,  # set by the caller
    DRIVE_STATE,
) = range(10)
"""Indices of a row: the state at its period's start, and what acts during it."""

# where the layouts of DriveCommand and PositionFeedback say where their signals lie
_CONTROLWORD_START, _TARGET_START = CONFIGURATION_SIZE, CONFIGURATION_SIZE + 1
_SENSOR_STATUS_START, _POSITION_START = CONFIGURATION_SIZE, CONFIGURATION_SIZE + 1


@njit(
    "uint64(float64[::1], float64[::1], float64[::1], int64[::1], int64[::1], int64[::1], int64[::1],"
    " int64[::1], int64[::1], int64, uint64, int64, float64)",
    depends=(*e2e.SOURCES, "plant_sim"),
)
def run_period(  # type: ignore[no-untyped-def]
    state,
    parameters,
    row,
    drive,
    receiver,
    command,
    counter,
    feedback,
    sensor,
    periods,
    data,
    arrived,
    error_m,
):
    """Advance the plant, let the drive take its newest command, and return PositionFeedback's payload.

    Parameters
    ----------
    state, parameters : array of float64
        See `plant_sim.layout`.
    row : array of float64, shape (len(COLUMNS),)
        The last period's row on entry, this one's on return.
    drive : array of int64
        See `plant_sim.drive`.
    receiver : array of int64, shape (dbc.profile2.STATE_SIZE,)
        E2E state of DriveCommand.
    command, feedback : array of int64
        Layouts of DriveCommand and PositionFeedback, from `dbc.codec.MessageCodec.protected_layout`.
    counter : array of int64, shape (1,)
        E2E counter of PositionFeedback.
    sensor : array of int64
        See `plant_sim.sensors`. Of a silent sensor there is no payload, and the counter stays.
    periods : int
        Periods to advance with what acted in the last one.
    data, arrived : int
        Payload of the newest DriveCommand; 0 if none arrived since the last call.
    error_m : float
        Error of the position sensor in this period.
    """
    row[TIME] += periods * PERIOD_NS
    for _ in range(periods):
        advance(state, parameters, row[SPEED_COMMAND], row[LOAD], PERIOD_S, SUBSTEPS)
    row[POSITION] = state[at.POSITION]
    row[VELOCITY] = state[at.VELOCITY]
    row[PRESSURE_A] = state[at.PRESSURE_A]
    row[PRESSURE_B] = state[at.PRESSURE_B]
    row[PRESSURE_ACCUMULATOR] = accumulator_pressure(state[at.OIL_VOLUME], parameters)
    row[MOTOR_SPEED] = state[at.MOTOR_SPEED]
    status = e2e.profile2_check(receiver, command[:CONFIGURATION_SIZE], data, arrived)
    payload = np.int64(data)
    controlword = (payload >> command[_CONTROLWORD_START]) & 0xFFFF
    target = (((payload >> command[_TARGET_START]) & 0xFFFF) ^ 0x8000) - 0x8000
    row[SPEED_COMMAND] = drive_step(drive, controlword, target, status in e2e.ACCEPTED)
    row[DRIVE_STATE] = drive[STATE]
    if sensor[IS_SILENT]:
        return np.uint64(0)
    reading = sensor[STATUS] << feedback[_SENSOR_STATUS_START]
    reading |= (reported_um(sensor, state[at.POSITION] + error_m) & 0xFFFF_FFFF) << feedback[_POSITION_START]
    return e2e.profile2_protect(counter, feedback[:CONFIGURATION_SIZE], np.uint64(reading))
