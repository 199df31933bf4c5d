"""The machine's node: drive, position sensor and pressure sensors around the simulated plant."""

import math
from functools import partial

import numpy as np

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.jit import entry_point
from dbc.messages import BenchCommand, BenchFault, BenchParameter
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.packet import HEAD_DLC, NOT_ANSWERED, answer_by_entry_points, append_frame, event_ns
from dbc.profile2 import STATE_SIZE
from dbc.record import Record
from plant_sim.answer import answer_timer
from plant_sim.drive import COUNTS_PER_RPM, Drive
from plant_sim.equilibrium import initial_state
from plant_sim.parameters import MAX_LOAD_N, PlantParameters
from plant_sim.period import (
    COLUMNS,
    LOAD,
    MOTOR_SPEED,
    PRESSURE_A,
    PRESSURE_ACCUMULATOR,
    TIME,
    run_period,
)
from plant_sim.sensors import PositionSensor, pressure_count

_STATUS_PERIODS = 10
_STATUS_PHASE = 2
_PRESSURE_PHASE = 4
_COUNTS_PER_RAD_S = 30.0 * COUNTS_PER_RPM / math.pi
_RESET_LSB_M = 1e-7
_COUNTS_PER_UNIT = 1e6
_FAULTS, _PARAMETERS = frozenset(BenchFault), frozenset(BenchParameter)
_run_period, _answer_timer = entry_point(run_period), entry_point(answer_timer)


class Plant:
    """Drive, sensors and plant on one 1 ms clock.

    At each timer call the plant is brought up to now, the position is sampled and sent, and the drive takes
    the newest DriveCommand and holds it for one period.

    What the bench asked for since the last call is done then too, in the order in which it was heard: a load
    has acted since that call, a sensor's fault is in the sample now taken, a scaled parameter acts from now
    on. Scales are those of the machine as built, clipped to the bounds of `plant_sim.parameters`; state stays
    what it is, so nothing jumps but what follows from it at once (the accumulator holds its oil under the new
    precharge). The drive knows nothing of a motor that lost speed or acceleration. A reset puts back the
    machine as built, without faults.

    Parameters
    ----------
    contract : Contract
        The DBC.
    parameters : PlantParameters
        The machine.
    sensor : PositionSensor, optional
        Default: 1 µm, no noise.
    delay_periods : int
        Drive cycles from the sample on whose account a command was sent to the drive taking it, 1 to 3.

    Attributes
    ----------
    record : Record
        One row per period: the state at its start and what acts during it, SI units.
    """

    name = "plant"

    def __init__(
        self,
        contract: Contract,
        parameters: PlantParameters,
        sensor: PositionSensor | None = None,
        delay_periods: int = 1,
    ) -> None:
        self._contract = contract
        self._parameters = parameters
        self._sensor = sensor or PositionSensor()
        self._delay_periods = delay_periods
        self.accepts = frozenset(
            message.can_id
            for message in (contract.drive_command, contract.bench_control, contract.bench_load)
        )
        self.latched = self.accepts
        self._command_id = contract.drive_command.can_id
        self.transmits = frozenset(
            message.can_id
            for message in (contract.position_feedback, contract.drive_status, contract.pressure_feedback)
        )
        self._command_layout = contract.drive_command.protected_layout()
        self._feedback_layout = contract.position_feedback.protected_layout()
        self._feedback = contract.position_feedback
        self._command_dlc = contract.drive_command.dlc
        self.record = Record(COLUMNS, np.float64)
        self.on_start(0)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: at rest, retracted, drive off."""
        self._receiver = np.zeros(STATE_SIZE, np.int64)
        self._feedback_counter = np.zeros(1, np.int64)
        self._protect_status = self._contract.drive_status.protector().protect
        self._command_frame: Frame | None = None
        self._bench_frames: list[Frame] = []
        first_ns = next_period(now_ns)
        self._restart(0.0, first_ns)
        return Actions(first_ns)

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Latch: the newest command, and all that the bench asks for."""
        if frame.can_id == self._command_id:
            self._command_frame = frame
        else:
            self._bench_frames.append(frame)
        return NOTHING

    def on_timer(self, now_ns: int) -> Actions:
        """Simulate up to now, send what the sensors say, and let the drive take its command."""
        is_rescaled = self._take_bench_frames(now_ns) if self._bench_frames else False
        periods = (now_ns - int(self._row[TIME])) // PERIOD_NS
        frame, self._command_frame = self._command_frame, None
        arrived = frame is not None and frame.dlc == self._command_dlc
        data = frame.data if frame is not None else 0
        payload = self._run_period(periods, data, arrived, self._sensor.error_m(now_ns))
        self.record.append(self._row)
        if is_rescaled:
            scales = {parameter.name.lower(): factor for parameter, factor in self._scales.items()}
            self._vector[:] = self._parameters.scaled_within_bounds(**scales).vector()
        frames = () if self._sensor.is_silent else (self._feedback.frame(payload),)
        sends = tuple((now_ns, frame) for frame in (*frames, *self._other_frames(now_ns)))
        return Actions(int(self._row[TIME]) + PERIOD_NS, sends)

    def answer(self, packet: memoryview, answer: bytearray) -> int:
        """Do all that an event asks for in one call; see `dbc.packet`."""
        length = NOT_ANSWERED
        if self._sensor.is_plain and self._command_frame is None and not self._bench_frames:
            length = self._answer_timer(self.record.rows, self.record.count, packet, answer)
        if length == NOT_ANSWERED:
            return answer_by_entry_points(self, packet, answer)
        now_ns = event_ns(packet)
        for frame in self._other_frames(now_ns):
            length = append_frame(answer, length, now_ns, frame)
        return length

    def _other_frames(self, now_ns: int) -> tuple[Frame, ...]:
        """Return what is sent beside PositionFeedback in this period."""
        phase = now_ns // PERIOD_NS % _STATUS_PERIODS
        if phase == _STATUS_PHASE:
            return (self._status_frame(),)
        return (self._pressure_frame(),) if phase == _PRESSURE_PHASE else ()

    def _status_frame(self) -> Frame:
        status = self._contract.drive_status
        counts = round(float(self._row[MOTOR_SPEED]) * _COUNTS_PER_RAD_S)
        return status.frame(self._protect_status(status.pack(self._drive.statusword, counts)))

    def _pressure_frame(self) -> Frame:
        pressure = self._contract.pressure_feedback
        pressures_pa = self._row[PRESSURE_A : PRESSURE_ACCUMULATOR + 1].tolist()
        return pressure.frame(pressure.pack(*map(pressure_count, pressures_pa)))

    def _restart(self, position_m: float, time_ns: float) -> None:
        parameters = self._parameters
        self._state = initial_state(parameters, position_m)
        self._vector = parameters.vector()
        self._scales: dict[BenchParameter, float] = {}
        self._sensor.restart()
        self._drive = Drive(
            parameters.motor_speed_rpm, parameters.motor_acceleration_rad_s2, self._delay_periods
        )
        self._row = np.zeros(len(COLUMNS))
        self._row[TIME] = time_ns
        arrays = (
            self._state,
            self._vector,
            self._row,
            self._drive.words,
            self._receiver,
            self._command_layout,
            self._feedback_counter,
            self._feedback_layout,
            self._sensor.words,
        )
        self._run_period = partial(_run_period, *arrays)
        feedback_head = self._feedback.can_id | self._feedback.dlc << HEAD_DLC
        self._answer_timer = partial(_answer_timer, self._command_id, feedback_head, *arrays)

    def _take_bench_frames(self, now_ns: int) -> bool:
        """Do what the bench asked for; return whether a parameter is to be scaled after this period."""
        control, load = self._contract.bench_control, self._contract.bench_load
        is_rescaled = False
        for frame in self._bench_frames:
            if frame.can_id == load.can_id:
                force_n = float(load.unpack(frame.data).force)
                self._row[LOAD] = min(max(force_n, -MAX_LOAD_N), MAX_LOAD_N)
                self.record.amend("load_n", self._row[LOAD])  # it acts in all of the period that now ends
                continue
            asked = control.unpack(frame.data)
            if asked.command == BenchCommand.RESET:
                position_m = asked.value * _RESET_LSB_M
                self._restart(min(max(position_m, 0.0), self._parameters.stroke_m), self._row[TIME])
                is_rescaled = False
            elif asked.command == BenchCommand.SET_FAULT and asked.identifier in _FAULTS:
                self._sensor.set_fault(BenchFault(asked.identifier), asked.value / _COUNTS_PER_UNIT, now_ns)
            elif asked.command == BenchCommand.SCALE_PARAMETER and asked.identifier in _PARAMETERS:
                self._scales[BenchParameter(asked.identifier)] = asked.value / _COUNTS_PER_UNIT
                is_rescaled = True
        self._bench_frames.clear()
        return is_rescaled
