"""The supervisor node: brings the machine up, then plays the setpoints and load steps of a scenario."""

from collections.abc import Sequence

from dbc.contract import Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand
from dbc.node import NOTHING, PERIOD_NS, Actions, next_period
from dbc.record import Record
from hil.references import setpoint_counts
from hil.scenario import CONTROLLERS, Scenario

BRING_UP_PERIODS = 100
"""Periods from the supervisor's start to the first one of the reference: the drive is enabled in them."""

BRING_UP_S = BRING_UP_PERIODS * PERIOD_NS * 1e-9

_ENABLE_PERIOD = 20
_BRING_UP_COMMANDS = (1, 2, _ENABLE_PERIOD)
"""The first only starts the receiver's counter; the second, without Enable, arms the controller."""

_COMMAND_PERIODS = 100


class Supervisor:
    """Plays a scenario: setpoints every period, mode commands, load steps over the bench channel.

    Parameters
    ----------
    contract : Contract
        The DBC.
    scenario : Scenario
        What to play.
    controller : str
        One of `CONTROLLERS`.
    """

    name = "supervisor"
    accepts: frozenset[int] = frozenset()
    latched: frozenset[int] = frozenset()

    def __init__(self, contract: Contract, scenario: Scenario, controller: str) -> None:
        self.record = Record(("time_ns", "setpoint_raw", "load_n"), "q")
        self.start_ns = 0
        self._setpoints: Sequence[int] = setpoint_counts(scenario.reference_m()).tolist()
        self._loads = {round(time_s * 1e9) // PERIOD_NS: round(force_n) for time_s, force_n in scenario.load}
        self._law = 1 + CONTROLLERS.index(controller)
        self._setpoint = contract.position_setpoint
        self._command = contract.controller_command
        self._bench_control = contract.bench_control
        self._bench_load = contract.bench_load
        self._protect_setpoint = self._setpoint.protector().protect
        self._protect_command = self._command.protector().protect
        self._load_n = 0
        self._origin_ns = 0
        self._next_period = 0
        self.transmits = frozenset({self._setpoint.can_id, self._command.can_id})

    @property
    def played_periods(self) -> int:
        """Periods since power-on that are over, missed ones included."""
        return self._next_period

    @property
    def periods(self) -> int:
        """Periods from power-on to the end of the scenario."""
        return BRING_UP_PERIODS + len(self._setpoints)

    def on_start(self, now_ns: int) -> Actions:
        """Power-on: the machine is put to its initial state with the first period."""
        self._origin_ns = next_period(now_ns)
        self.start_ns = self._origin_ns + BRING_UP_PERIODS * PERIOD_NS
        return Actions(self._origin_ns)

    def on_timer(self, now_ns: int) -> Actions:
        """Send this period's setpoint, and what else is due."""
        period = (now_ns - self._origin_ns) // PERIOD_NS
        k = period - BRING_UP_PERIODS
        raw = self._setpoints[min(max(k, 0), len(self._setpoints) - 1)]
        frames = [self._setpoint.frame(self._protect_setpoint(self._setpoint.pack(raw)))]
        if period == 0:
            frames.append(self._reset_frame())
            frames.append(self._load_frame())
        if period in _BRING_UP_COMMANDS or (period > 0 and period % _COMMAND_PERIODS == 0):
            frames.append(self._command_frame(period >= _ENABLE_PERIOD))
        if k in self._loads:
            self._load_n = self._loads[k]
            frames.append(self._load_frame())
        self.record.append((now_ns, raw, self._load_n))
        self._next_period = period + 1
        wake_ns = self._origin_ns + self._next_period * PERIOD_NS
        return Actions(wake_ns, tuple((now_ns, frame) for frame in frames))

    def on_frame(self, now_ns: int, frame: Frame) -> Actions:
        """Hear nothing: the acceptance filter is empty."""
        return NOTHING

    def _command_frame(self, enable: bool) -> Frame:
        message = self._command
        payload = self._protect_command(message.pack(int(enable), self._law, 0))
        return message.frame(payload)

    def _reset_frame(self) -> Frame:
        message = self._bench_control
        return message.frame(message.pack(BenchCommand.RESET, 0, self._setpoints[0]))

    def _load_frame(self) -> Frame:
        message = self._bench_load
        return message.frame(message.pack(self._load_n))
