"""What a test holds in its hand: command, run, assert in units."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dbc.codec import signal_name
from dbc.contract import Contract
from dbc.node import PERIOD_NS
from firmware_py.diagnosis import Fault
from firmware_py.diagnosis import State as ControllerState
from hil.bus.wire import ErrorState
from hil.faults.catalogue import fault_of
from hil.faults.fault import Fault as InjectedFault
from hil.measure import M_TO_MM, Trace, bus_load_of_windows, figures_of, setting_of, timing_in, trace_of
from hil.report import OutputDirectory
from hil.run.options import BenchError, Recording
from hil.run.rig import Rig
from hil.scenario import PERIOD_S, TimingLimits, controller_of
from hil.signals import Series, signal_of
from hil.supervisor import BRING_UP_PERIODS, Reference
from hil.timing import Figure, Timing
from plant_sim.parameters import MAX_LOAD_N, PlantParameters

STROKE_M = PlantParameters().stroke_m

RECOVERY_STEPS = ((0, {"enable": 0, "fault_reset": 0}), (3, {"fault_reset": 1}), (50, {"fault_reset": 0}))
"""Periods from now and mode commands that bring a controller from its safe state back to standby."""


class Bench:
    """A run that is steered step by step.

    It begins with the machine at rest, brought up and enabled: time 0 is the first period after that. What is
    asked for takes effect when `run` goes on. In virtual time nothing passes between two runs; in real time
    the setpoints keep coming, and `run` goes on to where it would be had no time been lost.

    Parameters
    ----------
    rig : Rig
        Bus and nodes; its sessions come one after another.
    controller : str
        Control law, one of `hil.scenario.CONTROLLERS`; by default that of the rig's tuning.
    position_m : float
        Where the machine starts.
    bit_rate : int, optional
        Bit/s, if not the rig's own; in virtual time only.

    Raises
    ------
    BenchError
        If a process was lost, or the bit rate cannot be had.
    """

    def __init__(
        self, rig: Rig, controller: str = "", position_m: float = 0.0, bit_rate: int | None = None
    ) -> None:
        if not 0.0 <= position_m <= STROKE_M:
            raise ValueError(f"position_m is {position_m}, must be from 0 to {STROKE_M} m")
        self.mode = rig.mode
        self.bit_rate = bit_rate or rig.bit_rate
        self.controller = controller or controller_of(rig.options.tuning.calibration.law)
        self._setting = setting_of(rig.options)
        self._contract = rig.contract
        self._session = rig.begin(self.controller, position_m, bit_rate)
        self._supervisor = self._session.supervisor
        self._period = BRING_UP_PERIODS
        self._faults: list[InjectedFault] = []
        self._recording: Recording | None = None
        self._trace: Trace | None = None
        self._timing: Timing | None = None
        self._go_on()

    # commands

    def setpoint(self, reference: float | Reference) -> None:
        """Follow a reference from now on: a position in m, or a function of the time from now (s, array)."""
        if callable(reference):
            follow = reference
        else:
            position_m = float(reference)
            highest_m = self._contract.position_setpoint.signals["Position"].maximum
            if highest_m is not None and abs(position_m) > highest_m:
                raise ValueError(f"a setpoint of {position_m} m is beyond {highest_m} m")

            def follow(time_s: np.ndarray) -> np.ndarray:
                return np.full(len(time_s), position_m)

        self._supervisor.plan(self._period, reference=follow)

    def load_force(self, force_n: float) -> None:
        """Let a force act on the rod, N; positive resists extension."""
        if abs(force_n) > MAX_LOAD_N:
            raise ValueError(f"{force_n} N is beyond {MAX_LOAD_N:g} N")
        self._supervisor.plan(self._period, load_n=round(force_n))

    def enable(self) -> None:
        """Ask for closed-loop control."""
        self._supervisor.plan(self._period, enable=1)

    def disable(self) -> None:
        """Ask for standby."""
        self._supervisor.plan(self._period, enable=0)

    def recover(self) -> None:
        """Ask to leave the safe state: withdraw the enable, reset the fault; takes 60 ms of `run`."""
        begin = max(self._period, self._supervisor.next_period)
        for periods, words in RECOVERY_STEPS:
            self._supervisor.plan(begin + periods, **words)

    def silence(self, *messages: str) -> None:
        """Hold back messages of the supervisor, e.g. PositionSetpoint."""
        self._supervisor.silent |= {self._contract.message(name).can_id for name in messages}

    def unsilence(self, *messages: str) -> None:
        """Send them again."""
        self._supervisor.silent -= {self._contract.message(name).can_id for name in messages}

    def run(self, duration_s: float) -> None:
        """Go on.

        Raises
        ------
        BenchError
            If a process was lost.
        """
        periods = round(duration_s / PERIOD_S)
        if periods < 1:
            raise ValueError(f"duration_s is {duration_s}, must be one period of {PERIOD_S} s or more")
        self._period += periods
        self._go_on()

    # what can go wrong

    def inject(self, fault: str | InjectedFault, **parameters: Any) -> None:
        """Let something go wrong, now or `at_s` seconds from now.

        Parameters
        ----------
        fault : str or hil.faults.fault.Fault
            A kind of `hil.faults.catalogue`, with its parameters, or a fault.

        Raises
        ------
        FaultError
            If there is no such fault, or it cannot be had in this mode.
        """
        if isinstance(fault, str):
            fault = fault_of(fault, parameters)
        begin = max(self._period, self._supervisor.next_period)
        self._session.inject(fault, begin * PERIOD_NS)
        self._faults.append(replace(fault, at_s=(begin - BRING_UP_PERIODS) * PERIOD_S + fault.at_s))

    def drop(self, message: str, count: int = 1) -> None:
        """Inject a `drop`."""
        self.inject("drop", message=message, count=count)

    def corrupt(self, message: str, bit: int, count: int = 1) -> None:
        """Inject a `corrupt`."""
        self.inject("corrupt", message=message, bit=bit, count=count)

    def delay(self, message: str, delay_s: float, count: int = 1) -> None:
        """Inject a `delay`."""
        self.inject("delay", message=message, delay_s=delay_s, count=count)

    def repeat(self, message: str, count: int = 1) -> None:
        """Inject a `repeat`."""
        self.inject("repeat", message=message, count=count)

    def destroy(self, message: str, bit: int = 20, count: int = 1) -> None:
        """Inject a `destroy`."""
        self.inject("destroy", message=message, bit=bit, count=count)

    def disturb(self, bit_error_rate: float, duration_s: float, seed: int = 0) -> None:
        """Inject `bit_errors`."""
        self.inject("bit_errors", rate=bit_error_rate, duration_s=duration_s, seed=seed)

    def power_off(self, node: str) -> None:
        """Inject a `power_off`."""
        self.inject("power_off", node=node)

    def power_on(self, node: str) -> None:
        """Inject a `reset`: start a node anew that was cut off, or reset one that was not."""
        self.inject("reset", node=node)

    def error_state(self, node: str) -> ErrorState:
        """Return error counters and state of a node's CAN controller, in virtual time."""
        wire = self._session.wire
        if wire is None:
            raise BenchError("error_state needs virtual time: use --hil-mode inprocess or lockstep")
        if node not in self._session.ports:
            known = ", ".join(sorted(self._session.ports))
            raise ValueError(f"there is no node {node!r}: choose one of {known}")
        return wire.error_state(self._session.ports[node])

    # what came of it

    @property
    def time_s(self) -> float:
        """Time since the bench was ready, s."""
        return (self._period - BRING_UP_PERIODS) * PERIOD_S

    @property
    def error_mm(self) -> Series:
        """Reference less position: the plant's own, or in real time the measured one; mm."""
        return self._column("error_m", M_TO_MM)

    @property
    def position_mm(self) -> Series:
        """Position, as for `error_mm`; mm."""
        return self._column("position_m", M_TO_MM)

    @property
    def motor_speed_rpm(self) -> Series:
        """Motor speed; in real time as DriveStatus reports it."""
        return self._column("motor_speed_rpm", 1.0)

    @property
    def feedback_age_us(self) -> Figure:
        """See `hil.timing.Timing`."""
        return self.timing.feedback_age_us

    @property
    def setpoint_age_us(self) -> Figure:
        """See `hil.timing.Timing`."""
        return self.timing.setpoint_age_us

    @property
    def latency_us(self) -> Figure:
        """See `hil.timing.Timing`."""
        return self.timing.latency_us

    @property
    def jitter_us(self) -> Figure:
        """See `hil.timing.Timing`."""
        return self.timing.jitter_us

    @property
    def timing(self) -> Timing:
        """Timing of every control period since time 0."""
        if self._timing is None:
            self._timing = timing_in(self.recording, self.trace, self._contract, self.bit_rate, self.mode)
        return self._timing

    def bus_load_percent(self, window_s: float = 0.01) -> Series:
        """Return the bus load of every window since time 0, %, the bench channel left out."""
        return bus_load_of_windows(self.recording, self._contract, self.bit_rate, window_s)

    def check_timing(self, limits: TimingLimits) -> None:
        """Make sure that every control period met its limits.

        Raises
        ------
        AssertionError
            Naming the periods that did not, and the frames involved.
        """
        if broken := self.timing.violations(limits):
            raise AssertionError(f"{len(broken)} timing violations:\n" + "\n".join(map(str, broken[:10])))

    @property
    def controller_state(self) -> ControllerState | None:
        """State of the controller: now, or in real time as last reported (every 100 ms)."""
        value = self._newest("controller_state", "ControllerStatus.State")
        return None if value is None else ControllerState(value)

    @property
    def controller_faults(self) -> set[str]:
        """Names of the controller's fault signals that are set; as up to date as `controller_state`."""
        if "controller_faults" in self.trace:
            bits = self._newest("controller_faults", "")
            return {signal_name(str(fault.name)) for fault in Fault(bits or 0)}
        signals = self._contract.message("ControllerStatus").signals
        flags = [name for name, signal in signals.items() if signal.length == 1]
        return {name for name in flags if self._newest("", f"ControllerStatus.{name}") == 1}

    def signal(self, name: str) -> Series:
        """Return ``Message.Signal`` from the bus, in its unit, over the time since time 0."""
        recording = self.recording
        return signal_of(recording.traffic, self._contract, name, recording.start_ns)

    @property
    def trace(self) -> Trace:
        """One row per control period since time 0; see `hil.measure.trace_of`."""
        if self._trace is None:
            self._trace = trace_of(self.recording, self._contract)
        return self._trace

    @property
    def recording(self) -> Recording:
        """All there is so far."""
        if self._recording is None:
            self._recording = self._session.recording()
        return self._recording

    @property
    def contract(self) -> Contract:
        """The DBC."""
        return self._contract

    def result(self, name: str) -> dict[str, Any]:
        """Return the figures so far, under the name of a test."""
        figures = figures_of(
            self.recording, self.trace, self.timing, self._contract, self.bit_rate, self.mode, self._faults
        )
        return {
            "scenario": name,
            "controller": self.controller,
            **self._setting,
            **figures,
            "paper": None,
        }

    def write(self, folder: Path, name: str) -> list[Path]:
        """Leave figures, trace, bus log and picture in a folder; return the files."""
        with OutputDirectory(folder, ".log") as directory:
            return directory.write(self.result(name), self.trace, self.recording)

    def end(self) -> None:
        """Keep what there is and leave the machine disabled; nothing runs afterwards."""
        self._recording = self.recording  # the rig forgets it when another run begins
        self._session.end()

    def _go_on(self) -> None:
        self._recording = self._trace = self._timing = None
        if not self._session.ending:
            self._session.run_to(self._period)
        if self._session.ending:
            raise BenchError(self._session.ending)

    def _column(self, name: str, factor: float) -> Series:
        return Series(self.trace["time_s"], self.trace[name] * factor)

    def _newest(self, column: str, signal: str) -> int | None:
        """Return the newest known value of a trace column, or where there is none of a signal."""
        series = self._column(column, 1.0) if column in self.trace else self.signal(signal)
        return int(series.last) if series.known.size else None
