"""The controller node, driven as its interrupts would drive it: frames in, frames out."""

import ast
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cantools
import pytest

import firmware_py.answer
import firmware_py.contract_words
import firmware_py.entry_points
import firmware_py.node
from dbc.contract import PACKAGED_DBC, Contract
from dbc.frame import Frame
from dbc.messages import BenchCommand
from dbc.node import NOTHING
from firmware_py import task
from firmware_py import task_layout as at
from firmware_py.contract_words import contract_words
from firmware_py.diagnosis import Fault, State
from firmware_py.kernel import layout as k
from firmware_py.kernel.layout import FLAG_SPEED_LIMITED, LAW_ADRC, LAW_P, LAW_PI
from firmware_py.node import EXECUTION_NS, Controller
from firmware_py.tuning import VELOCITY_LSB_RAD_S, PiTuning, Tuning

CONTRACT = Contract.load()
BLOCK = Tuning().calibration().to_bytes()
PERIOD_NS = 1_000_000
POSITION_UM = 100_000

SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED = 0x0250, 0x0231, 0x0233, 0x1237
QUICK_STOP_ACTIVE, FAULT_REACTION, DRIVE_FAULT = 0x0217, 0x021F, 0x0218
SHUTDOWN, SWITCH_ON, ENABLE_OPERATION, DISABLE_VOLTAGE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80


class Output(NamedTuple):
    """What one control period came to."""

    controlword: int
    target_velocity: int
    state: int
    faults: Fault


@dataclass
class Inputs:
    """What the controller is sent every period, and what is done to each message on its way."""

    position_um: int = POSITION_UM
    sensor_status: int = 0
    setpoint_0p1um: int = 10 * POSITION_UM
    enable: int = 0
    law: int = LAW_ADRC
    fault_reset: int = 0
    statusword: int = ENABLED


class Rig:
    """A controller and all that talks to it, one call per control period."""

    def __init__(self, block: bytes = BLOCK) -> None:
        self.controller = Controller(CONTRACT, block)
        self.inputs = Inputs()
        self.sent: list[tuple[int, Frame]] = []
        self.outputs: list[Output] = []
        self.now_ns = 0
        self._codecs = {
            "feedback": CONTRACT.position_feedback,
            "setpoint": CONTRACT.position_setpoint,
            "command": CONTRACT.controller_command,
            "drive_status": CONTRACT.drive_status,
        }
        self._protect = {name: codec.protector().protect for name, codec in self._codecs.items()}
        self._last: dict[str, Frame] = {}
        assert self.controller.on_start(0).wake_ns == 0

    def _payload(self, name: str) -> int:
        inputs = self.inputs
        return {
            "feedback": lambda: CONTRACT.position_feedback.pack(inputs.sensor_status, inputs.position_um),
            "setpoint": lambda: CONTRACT.position_setpoint.pack(inputs.setpoint_0p1um),
            "command": lambda: CONTRACT.controller_command.pack(
                inputs.enable, inputs.law, inputs.fault_reset
            ),
            "drive_status": lambda: CONTRACT.drive_status.pack(inputs.statusword, 0),
        }[name]()

    def next_frame(self, name: str) -> Frame:
        return self._codecs[name].frame(self._protect[name](self._payload(name)))

    def hear(self, frame: Frame) -> None:
        assert self.controller.on_frame(self.now_ns - PERIOD_NS // 2, frame) is NOTHING

    def period(self, **damage: str) -> Output:
        """Send every message, but do to each what `damage` says of it, then fire the timer."""
        for name in self._codecs:
            kind = damage.get(name)
            if kind == "repeated":
                self.hear(self._last[name])
                continue
            frame = self.next_frame(name)
            if kind == "out_of_sequence":
                for _ in range(5):
                    frame = self.next_frame(name)
            elif kind == "corrupt":
                frame = frame._replace(data=frame.data ^ 0x0010_0000)
            elif kind == "wrong_dlc":
                frame = frame._replace(dlc=frame.dlc - 1)
            if kind != "lost":
                self.hear(frame)
                self._last[name] = frame
        return self.timer()

    def timer(self) -> Output:
        wake_ns, sends = self.controller.on_timer(self.now_ns)
        assert wake_ns == self.now_ns + PERIOD_NS
        self.now_ns = wake_ns
        self.sent = list(sends)
        (command,) = [f for _, f in sends if f.can_id == CONTRACT.drive_command.can_id]
        record = self.controller.record.columns_by_name()
        output = Output(
            *CONTRACT.drive_command.unpack(command.data),
            int(record["state"][-1]),
            Fault(int(record["faults"][-1])),
        )
        self.outputs.append(output)
        return output

    def periods(self, count: int, **damage: str) -> Output:
        for _ in range(count):
            output = self.period(**damage)
        return output


@pytest.fixture
def standby() -> Rig:
    """Everything is there but the enable."""
    rig = Rig()
    assert rig.periods(5).state == State.STANDBY
    return rig


@pytest.fixture
def running() -> Rig:
    return run(Rig())


@pytest.fixture
def tripped(running: Rig) -> Rig:
    """Feedback was lost, and is back."""
    assert running.periods(3, feedback="lost").state == State.SAFE
    running.periods(5)
    return running


def run(rig: Rig) -> Rig:
    rig.periods(5)
    rig.inputs.enable = 1
    assert rig.periods(2).state == State.RUN
    return rig


def set_inputs(rig: Rig, **values: int) -> Rig:
    for name, value in values.items():
        setattr(rig.inputs, name, value)
    return rig


# one period


def test_the_command_leaves_after_the_execution_time(running):
    now_ns = running.now_ns
    running.period()
    assert {send_ns for send_ns, _ in running.sent} == {now_ns + EXECUTION_NS}
    assert EXECUTION_NS == 100_000


def test_the_command_is_protected_with_a_running_counter(running):
    check = CONTRACT.drive_command.checker().check
    statuses = []
    for _ in range(40):
        running.period()
        statuses.append(check(running.sent[0][1].data))
    assert [status.name for status in statuses] == ["INITIAL"] + ["OK"] * 39


def test_a_late_timer_goes_on_with_the_next_whole_period(running):
    late_ns = running.now_ns + 2_300_000
    assert running.controller.on_timer(late_ns).wake_ns == running.now_ns + 3_000_000


def test_a_setpoint_ahead_of_the_position_extends_and_one_behind_retracts(running):
    assert running.period().target_velocity == 0
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM + 1000)
    assert running.periods(50).target_velocity > 0
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM - 1000)
    assert running.periods(200).target_velocity < 0


def test_the_filter_accepts_what_the_node_reads_and_all_of_it_is_latched():
    controller = Controller(CONTRACT, BLOCK)
    read = ("position_feedback", "position_setpoint", "controller_command", "drive_status", "bench_control")
    assert controller.accepts == {getattr(CONTRACT, name).can_id for name in read}
    assert controller.latched == controller.accepts


def test_the_law_asked_for_is_taken_over_in_standby_only(running):
    assert controller_status(running)["ControlLaw"] == "ADRC"
    set_inputs(running, law=LAW_PI)
    assert controller_status(running)["ControlLaw"] == "ADRC"
    set_inputs(running, enable=0)
    running.periods(2)
    set_inputs(running, enable=1)
    running.periods(2)
    assert controller_status(running)["ControlLaw"] == "PI"


@pytest.mark.parametrize(("law", "name"), enumerate(("P", "PI", "ADRC", "PI_FF", "Scheduled"), start=1))
def test_each_law_asked_for_is_reported(law, name):
    assert controller_status(run(set_inputs(Rig(), law=law)))["ControlLaw"] == name


def test_before_the_first_run_the_calibrations_law_is_reported(standby):
    assert controller_status(standby)["ControlLaw"] == "ADRC"


def test_law_zero_moves_as_the_calibrations_own_does():
    velocities = []
    for law in (0, LAW_ADRC):
        rig = run(set_inputs(Rig(), law=law))
        set_inputs(rig, setpoint_0p1um=10 * POSITION_UM + 1000)
        velocities.append([rig.period().target_velocity for _ in range(20)])
    assert velocities[0] == velocities[1]
    assert any(velocities[0])


def test_no_command_yet_is_no_command_without_enable():
    rig = set_inputs(Rig(), enable=1)
    rig.periods(20, command="lost")
    assert rig.periods(20).state == State.STANDBY


def test_law_zero_asks_for_the_calibrations_own():
    rig = set_inputs(Rig(), law=0)
    assert controller_status(run(rig))["ControlLaw"] == "ADRC"


# power-on and standby


def test_power_on_passes_to_standby_and_commands_nothing():
    assert Rig().timer() == Output(
        DISABLE_VOLTAGE,
        0,
        State.STANDBY,
        Fault.FEEDBACK_LOST | Fault.SETPOINT_LOST | Fault.COMMAND_LOST | Fault.DRIVE_STATUS_LOST,
    )


def test_standby_keeps_the_drive_disabled(standby):
    for statusword in (SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED):
        output = set_inputs(standby, statusword=statusword).periods(3)
        assert output == (SHUTDOWN, 0, State.STANDBY, 0)


def test_the_drive_is_enabled_step_by_step_by_its_statusword(standby):
    standby.inputs.enable = 1
    steps = [
        (SWITCH_ON_DISABLED, SHUTDOWN, State.STANDBY),
        (READY, SWITCH_ON, State.STANDBY),
        (SWITCHED_ON, ENABLE_OPERATION, State.STANDBY),
        (ENABLED, ENABLE_OPERATION, State.RUN),
    ]
    for statusword, controlword, state in steps:
        output = set_inputs(standby, statusword=statusword).period()
        assert output[:3] == (controlword, 0, state)


def test_a_drive_that_is_stopping_is_left_to_finish(standby):
    set_inputs(standby, enable=1, statusword=QUICK_STOP_ACTIVE)
    assert standby.period()[:3] == (QUICK_STOP, 0, State.STANDBY)


def test_a_faulty_drive_gets_no_voltage_until_a_reset_is_asked_for(standby):
    set_inputs(standby, statusword=DRIVE_FAULT)
    assert standby.period() == (DISABLE_VOLTAGE, 0, State.STANDBY, Fault.DRIVE_FAULT)
    set_inputs(standby, fault_reset=1)
    assert standby.period().controlword == RESET


@pytest.mark.parametrize("statusword", [0x0219, 0x021A, 0x021C, 0x0241, 0x0258])
def test_a_statusword_of_no_state_gets_no_voltage_and_no_reset(standby, statusword):
    set_inputs(standby, statusword=statusword, enable=1, fault_reset=1)
    assert standby.period().controlword == DISABLE_VOLTAGE


def test_a_drive_that_still_reacts_to_its_fault_is_not_reset_yet(standby):
    """The edge would be lost on it."""
    set_inputs(standby, statusword=FAULT_REACTION, fault_reset=1)
    assert standby.period().controlword != RESET
    set_inputs(standby, statusword=DRIVE_FAULT)
    assert standby.period().controlword == RESET


@pytest.mark.parametrize("missing", ["feedback", "setpoint", "command", "drive_status"])
def test_no_run_while_an_input_is_missing(standby, missing):
    standby.periods(1000, **{missing: "lost"})
    standby.inputs.enable = 1
    output = standby.periods(10, **{missing: "lost"})
    assert (output.state, output.target_velocity) == (State.STANDBY, 0)


def test_withdrawing_the_enable_goes_to_standby_and_giving_it_back_to_run(running):
    set_inputs(running, enable=0)
    assert running.period() == (SHUTDOWN, 0, State.STANDBY, 0)
    set_inputs(running, enable=1)
    assert running.period().state == State.RUN


@pytest.mark.parametrize("damaged", [b"", BLOCK[:-1], BLOCK[:30] + b"\x55" + BLOCK[31:]])
def test_a_damaged_calibration_keeps_it_in_power_on(damaged):
    rig = set_inputs(Rig(damaged), enable=0)
    rig.periods(5)
    set_inputs(rig, enable=1, fault_reset=1)
    outputs = {rig.period() for _ in range(50)}
    assert outputs == {Output(SHUTDOWN, 0, State.POWER_ON, Fault.CALIBRATION_INVALID)}


# into the safe state

DAMAGE = ("lost", "corrupt", "repeated", "out_of_sequence", "wrong_dlc")
CORRUPT = {"feedback": Fault.FEEDBACK_CORRUPT, "setpoint": Fault.SETPOINT_CORRUPT}
LOST = {"feedback": Fault.FEEDBACK_LOST, "setpoint": Fault.SETPOINT_LOST}


@pytest.mark.parametrize("message", ["feedback", "setpoint"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_the_third_bad_period_in_a_row_is_safe_at_once(running, message, damage):
    for _ in range(2):
        assert running.period(**{message: damage}).state == State.RUN
    faults = LOST[message] | (CORRUPT[message] if damage != "lost" else 0)
    assert running.period(**{message: damage}) == (QUICK_STOP, 0, State.SAFE, faults)


@pytest.mark.parametrize("message", ["feedback", "setpoint"])
@pytest.mark.parametrize("damage", ["lost", "corrupt", "repeated", "wrong_dlc"])
def test_two_bad_periods_are_tolerated_again_and_again(running, message, damage):
    for _ in range(20):
        running.periods(2, **{message: damage})
        assert running.period() == (ENABLE_OPERATION, 0, State.RUN, 0)


@pytest.mark.parametrize(
    ("damage", "inputs"),
    [({"feedback": "lost"}, {}), ({}, {"enable": 0}), ({}, {"statusword": READY})],
    ids=["safe", "standby", "drive left"],
)
def test_a_moving_machine_is_told_to_stand_still_as_soon_as_it_may_not_run(running, damage, inputs):
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM + 5000)
    assert running.periods(50).target_velocity > 0
    set_inputs(running, **inputs)
    outputs = [running.period(**damage) for _ in range(5)]
    stopped = [output for output in outputs if output.state != State.RUN]
    assert len(stopped) >= 3
    assert {output.target_velocity for output in stopped} == {0}


IMPLAUSIBLE = [
    ("position_um", -10_001, Fault.FEEDBACK_LOST | Fault.FEEDBACK_INVALID),
    ("position_um", 410_001, Fault.FEEDBACK_LOST | Fault.FEEDBACK_INVALID),
    ("sensor_status", 2, Fault.FEEDBACK_LOST | Fault.FEEDBACK_INVALID),
    ("setpoint_0p1um", -10_001, Fault.SETPOINT_LOST | Fault.SETPOINT_INVALID),
    ("setpoint_0p1um", 4_010_001, Fault.SETPOINT_LOST | Fault.SETPOINT_INVALID),
]


@pytest.mark.parametrize(("field", "value", "faults"), IMPLAUSIBLE)
def test_implausible_data_are_no_data(running, field, value, faults):
    set_inputs(running, **{field: value})
    assert running.periods(2).state == State.RUN
    assert running.period() == (QUICK_STOP, 0, State.SAFE, faults)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position_um", -10_000),
        ("position_um", 410_000),
        ("sensor_status", 1),
        ("setpoint_0p1um", -10_000),
        ("setpoint_0p1um", 4_010_000),
    ],
)
def test_the_last_plausible_value_is_used(running, field, value):
    assert set_inputs(running, **{field: value}).periods(5).state == State.RUN


@pytest.mark.parametrize(
    ("message", "periods", "faults"),
    [("command", 300, Fault.COMMAND_LOST), ("drive_status", 30, Fault.DRIVE_STATUS_LOST)],
)
def test_slower_messages_may_miss_two_of_their_cycles(running, message, periods, faults):
    assert running.periods(periods - 1, **{message: "lost"}).state == State.RUN
    assert running.period(**{message: "lost"}) == (QUICK_STOP, 0, State.SAFE, faults)


@pytest.mark.parametrize(
    ("message", "periods", "faults"),
    [
        ("command", 300, Fault.COMMAND_LOST | Fault.COMMAND_CORRUPT),
        ("drive_status", 30, Fault.DRIVE_STATUS_LOST | Fault.DRIVE_STATUS_CORRUPT),
    ],
)
def test_corrupt_slow_messages_are_lost_too(running, message, periods, faults):
    assert running.periods(periods, **{message: "corrupt"}) == (QUICK_STOP, 0, State.SAFE, faults)


@pytest.mark.parametrize("statusword", [SWITCH_ON_DISABLED, READY, SWITCHED_ON, QUICK_STOP_ACTIVE])
def test_a_drive_that_leaves_operation_on_its_own_is_a_fault(running, statusword):
    output = set_inputs(running, statusword=statusword).period()
    assert output == (QUICK_STOP, 0, State.SAFE, Fault.DRIVE_NOT_ENABLED)


@pytest.mark.parametrize("statusword", [DRIVE_FAULT, FAULT_REACTION])
def test_a_drive_fault_is_seen_as_one(running, statusword):
    output = set_inputs(running, statusword=statusword).period()
    assert output == (QUICK_STOP, 0, State.SAFE, Fault.DRIVE_NOT_ENABLED | Fault.DRIVE_FAULT)


def test_a_drive_that_leaves_operation_is_told_apart_after_a_mailbox_overrun_too(running):
    running.hear(running.next_frame("feedback"))
    assert running.period().faults == Fault.MAILBOX_OVERRUN
    output = set_inputs(running, statusword=READY).period()
    assert output.faults == Fault.MAILBOX_OVERRUN | Fault.DRIVE_NOT_ENABLED


def test_a_drive_that_stops_because_it_was_told_to_is_no_further_fault(tripped):
    output = set_inputs(tripped, statusword=SWITCH_ON_DISABLED).periods(20)
    assert output.faults == Fault.FEEDBACK_LOST


def test_the_safe_state_remembers_what_led_there(tripped):
    assert tripped.periods(500) == (QUICK_STOP, 0, State.SAFE, Fault.FEEDBACK_LOST)


# a position that does not move


def speed_up(rig: Rig, setpoint_0p1um: int = 3_000_000) -> Rig:
    """Ask for a motion until the first command of at least 1500 rpm."""
    set_inputs(rig, setpoint_0p1um=setpoint_0p1um)
    for _ in range(100):
        if abs(rig.period().target_velocity) >= 4 * 1500:
            return rig
    raise AssertionError("no fast command within 100 periods")


@pytest.mark.parametrize("setpoint_0p1um", [0, 3_000_000])
def test_a_position_that_stays_while_the_motor_turns_fast_is_stuck(running, setpoint_0p1um):
    speed_up(running, setpoint_0p1um)
    assert running.periods(49)[2:] == (State.RUN, 0)
    assert running.period() == (QUICK_STOP, 0, State.SAFE, Fault.POSITION_STUCK)


@pytest.mark.parametrize("moved_um", [1000, -1000])
def test_a_millimetre_is_no_motion(running, moved_um):
    speed_up(running).periods(48)
    set_inputs(running, position_um=POSITION_UM + moved_um)
    assert running.periods(2).faults == Fault.POSITION_STUCK


@pytest.mark.parametrize("moved_um", [1001, -1001])
def test_more_than_a_millimetre_shows_a_live_sensor(running, moved_um):
    speed_up(running).periods(49)
    set_inputs(running, position_um=POSITION_UM + moved_um)
    assert running.periods(50).state == State.RUN
    assert running.period().faults == Fault.POSITION_STUCK


def asked_to_turn(speed_rpm: float) -> Rig:
    """A controller that has just begun to command this speed, and goes on."""
    error_m = 0.04
    rig = Rig(Tuning(p=PiTuning(4 * speed_rpm * VELOCITY_LSB_RAD_S / error_m)).calibration().to_bytes())
    run(set_inputs(rig, law=LAW_P))
    set_inputs(rig, setpoint_0p1um=10 * POSITION_UM + round(error_m * 1e7))
    while rig.period().target_velocity != 4 * speed_rpm:
        assert len(rig.outputs) < 1000
    return rig


def test_a_motor_below_1500_rpm_may_turn_without_motion_for_long():
    """A leak that a load is held against takes speed."""
    assert asked_to_turn(1499.75).periods(1000)[2:] == (State.RUN, 0)


def test_a_motor_at_1500_rpm_may_not():
    assert asked_to_turn(1500.0).periods(50)[2:] == (State.SAFE, Fault.POSITION_STUCK)


def test_after_a_fault_reset_there_are_as_many_periods_again(running):
    speed_up(running).periods(50)
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM, enable=0, fault_reset=1)
    assert running.period().state == State.STANDBY
    set_inputs(running, fault_reset=0)
    speed_up(run(running))
    assert running.periods(49).state == State.RUN
    assert running.period().state == State.SAFE


# and out of it


def test_good_inputs_alone_do_not_end_the_safe_state(tripped):
    for enable in (1, 0, 1):
        assert set_inputs(tripped, enable=enable).periods(50).state == State.SAFE


def test_a_fault_reset_leads_to_standby_and_only_a_new_enable_to_run(tripped):
    assert set_inputs(tripped, fault_reset=1).period() == (SHUTDOWN, 0, State.STANDBY, 0)
    assert tripped.periods(50).state == State.STANDBY
    assert set_inputs(tripped, enable=0).period().state == State.STANDBY
    assert set_inputs(tripped, enable=1).period().state == State.RUN


def test_an_enable_withdrawn_in_the_safe_state_does_not_count(tripped):
    set_inputs(tripped, enable=0).periods(5)
    set_inputs(tripped, enable=1, fault_reset=1)
    assert tripped.periods(50).state == State.STANDBY


def test_a_reset_with_the_enable_withdrawn_needs_only_the_enable_afterwards(tripped):
    set_inputs(tripped, enable=0, fault_reset=1).periods(2)
    assert set_inputs(tripped, enable=1, fault_reset=0).period().state == State.RUN


def test_a_reset_that_was_asked_for_all_along_is_no_reset(running):
    set_inputs(running, fault_reset=1).periods(5)
    running.periods(3, feedback="lost")
    assert running.periods(50).state == State.SAFE
    set_inputs(running, fault_reset=0).period()
    assert set_inputs(running, fault_reset=1).period().state == State.STANDBY


@pytest.mark.parametrize("message", ["feedback", "setpoint"])
def test_a_reset_while_an_input_is_missing_is_spent(running, message):
    running.periods(3, **{message: "lost"})
    set_inputs(running, fault_reset=1).periods(3, **{message: "lost"})
    assert running.periods(50).state == State.SAFE


def test_after_a_reset_the_control_law_starts_anew(tripped):
    set_inputs(tripped, enable=0, fault_reset=1).periods(2)
    set_inputs(tripped, enable=1, position_um=200_000, setpoint_0p1um=2_000_000)
    assert tripped.period()[:3] == (ENABLE_OPERATION, 0, State.RUN)


# bench reset


def test_a_bench_reset_forgets_everything(running):
    running.hear(running.next_frame("feedback"))  # an overrun
    running.period()
    bench = CONTRACT.bench_control
    running.hear(bench.frame(bench.pack(BenchCommand.RESET, 0, 0)))
    output = running.timer()
    lost = Fault.FEEDBACK_LOST | Fault.SETPOINT_LOST | Fault.COMMAND_LOST | Fault.DRIVE_STATUS_LOST
    assert output == (DISABLE_VOLTAGE, 0, State.STANDBY, lost)
    assert controller_status(running)["MailboxOverruns"] == 0


def test_after_a_bench_reset_nothing_of_the_control_law_is_left(running):
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM + 5000, law=LAW_PI)
    running.periods(20)
    row = {name: values[-1] for name, values in running.controller.record.columns_by_name().items()}
    assert all(row[name] for name in ("setpoint_0p1um", "position_um", "flags", "v1", "v2", "z1"))
    bench = CONTRACT.bench_control
    running.hear(bench.frame(bench.pack(BenchCommand.RESET, 123, -456)))
    running.timer()
    row = {name: values[-1] for name, values in running.controller.record.columns_by_name().items()}
    assert {name for name, value in row.items() if value} == {"time_ns", "state", "faults"}


def test_what_comes_after_a_bench_reset_in_the_same_period_is_not_forgotten(running):
    """A timer that is late finds the reset, and what was sent after it, at once."""
    bench = CONTRACT.bench_control
    running.hear(bench.frame(bench.pack(BenchCommand.RESET, 0, 0)))
    set_inputs(running, enable=0).period()
    running.period()  # without what came in the period of the reset, this one would only start the counters
    assert set_inputs(running, enable=1).period().state == State.RUN


def test_a_restarted_controller_does_not_move_on_an_enable_that_was_held_all_along(running):
    running.controller.on_start(running.now_ns)
    assert running.periods(20).state == State.STANDBY
    running.inputs.enable = 0
    running.period()
    running.inputs.enable = 1
    assert running.periods(2).state == State.RUN


@pytest.mark.parametrize("command", [BenchCommand.NONE, BenchCommand.SET_FAULT, BenchCommand.SCALE_PARAMETER])
def test_other_bench_commands_do_not_reset(running, command):
    bench = CONTRACT.bench_control
    running.hear(bench.frame(bench.pack(command, 0, 0)))
    assert running.period().state == State.RUN


# what it tells the world

DATABASE = cantools.database.load_file(PACKAGED_DBC)


def controller_status(rig: Rig, **damage: str) -> dict:
    """Go on to the next ControllerStatus and decode it as any tool would."""
    for _ in range(100):
        rig.period(**damage)
        for _, frame in rig.sent:
            if frame.can_id == CONTRACT.controller_status.can_id:
                return DATABASE.decode_message("ControllerStatus", frame.data.to_bytes(8, "little"))
    raise AssertionError("no ControllerStatus within 100 periods")


def test_the_status_is_sent_every_100_ms(running):
    sent = []
    for _ in range(1000):
        running.period()
        sent += [send_ns for send_ns, f in running.sent if f.can_id == CONTRACT.controller_status.can_id]
    assert len(sent) == 10
    assert {later - earlier for earlier, later in itertools.pairwise(sent)} == {100_000_000}


def test_the_observers_seven_pages_go_round_one_per_10_ms(running):
    pages, cycles = [], []
    for _ in range(140):
        running.period()
        for _, frame in running.sent:
            if frame.can_id == CONTRACT.observer_state.can_id:
                page, cycle, _ = CONTRACT.observer_state.unpack(frame.data)
                pages.append(page)
                cycles.append(cycle)
    assert sorted(pages[:7]) == list(range(7))
    assert pages[:7] == pages[7:]
    assert {later - earlier for earlier, later in itertools.pairwise(cycles)} == {10}


def test_each_period_sends_its_command_and_in_their_turn_status_and_observer():
    rig = run(Rig())
    rig.controller.on_start(rig.now_ns)
    command, status, observer = (
        CONTRACT.drive_command.can_id,
        CONTRACT.controller_status.can_id,
        CONTRACT.observer_state.can_id,
    )
    for period in range(250):
        rig.period()
        due = [command, *[status] * (period % 100 == 0), *[observer] * (period % 10 == 7)]
        assert [frame.can_id for _, frame in rig.sent] == due


def test_the_pages_are_the_states_of_their_period(running):
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM + 5000)
    seen = {}
    for _ in range(140):
        running.period()
        row = {name: values[-1] for name, values in running.controller.record.columns_by_name().items()}
        for _, frame in running.sent:
            if frame.can_id == CONTRACT.observer_state.can_id:
                page, _, value = CONTRACT.observer_state.unpack(frame.data)
                seen[page] = value
                assert value == row[("v1", "v2", "v3", "z1", "z2", "z3", "z4")[page]]
    assert len(set(seen.values())) == 7


@pytest.mark.parametrize(
    ("overruns", "reported"),
    [((1, 2, 3, 4), 10), ((65_530, 4, 0, 0), 65_534), ((65_530, 0, 5, 0), 65_535), ((65_535,) * 4, 65_535)],
)
def test_the_count_of_overruns_stops_at_its_largest(overruns, reported):
    contract, mailboxes = contract_words(CONTRACT).tolist(), [0] * at.MAILBOXES_SIZE
    for number, count in enumerate(overruns):
        mailboxes[number * at.MAILBOX_SIZE + at.OVERRUNS] = count
    frames = [0] * at.FRAMES_SIZE
    task.send_status(contract, mailboxes, [0] * at.TASK_SIZE, [0] * k.IO_SIZE, frames, at.FRAME_SIZE)
    low, high = (word & 0xFFFF_FFFF for word in frames[at.FRAME_SIZE :][at.FRAME_LOW : at.FRAME_HIGH + 1])
    payload = (high << 32 | low).to_bytes(8, "little")
    assert DATABASE.decode_message("ControllerStatus", payload)["MailboxOverruns"] == reported


def test_the_status_shows_the_assumed_execution_time(running):
    assert controller_status(running)["ExecutionTime"] == EXECUTION_NS / PERIOD_NS * 100.0


def test_until_it_is_measured_a_tenth_of_the_period_is_assumed_to_be_executed():
    words = [0] * at.TASK_SIZE
    contract, mailboxes = contract_words(CONTRACT).tolist(), [0] * at.MAILBOXES_SIZE
    block = [0] * at.BLOCK_SIZE
    task.power_on(contract, mailboxes, words, block, [0] * k.ST_SIZE, [0] * k.IO_SIZE)
    assert words[at.EXECUTION_TIME] * 0.5 == 10.0


def test_the_status_shows_the_state(running):
    assert controller_status(running)["State"] == "Run"
    assert controller_status(running, feedback="lost")["State"] == "Safe"
    assert controller_status(Rig(b""))["State"] == "PowerOn"


@pytest.mark.parametrize("fault", Fault)
def test_each_fault_bit_has_its_signal(fault):
    """With everything lost or wrong that can be, one at a time."""
    name = "".join(part.capitalize() for part in fault.name.split("_"))
    rig = Rig(BLOCK if fault != Fault.CALIBRATION_INVALID else b"")
    if fault != Fault.CALIBRATION_INVALID:
        run(rig)
        assert controller_status(rig)[name] == 0
    causes = {
        Fault.FEEDBACK_INVALID: {"sensor_status": 2},
        Fault.SETPOINT_INVALID: {"setpoint_0p1um": 5_000_000},
        Fault.DRIVE_NOT_ENABLED: {"statusword": READY},
        Fault.DRIVE_FAULT: {"statusword": DRIVE_FAULT},
    }
    set_inputs(rig, **causes.get(fault, {}))
    source, _, kind = fault.name.lower().rpartition("_")
    damage = {source: kind} if kind in ("lost", "corrupt") else {}
    if fault == Fault.POSITION_STUCK:
        set_inputs(rig, setpoint_0p1um=3_000_000)
        rig.periods(200)
    if fault == Fault.MAILBOX_OVERRUN:
        rig.hear(rig.next_frame("setpoint"))
    for _ in range(4):
        status = controller_status(rig, **damage)
    assert status[name] == 1


def test_overwritten_frames_are_counted_over_all_mailboxes(running):
    for name in ("feedback", "feedback", "setpoint", "command"):
        running.hear(running.next_frame(name))
    status = controller_status(running)
    assert (status["MailboxOverruns"], status["MailboxOverrun"]) == (4, 1)


def test_limited_periods_are_counted(running):
    assert controller_status(running)["Saturations"] == 0
    set_inputs(running, position_um=400_000)  # 0.3 m away, and the limiter only tempers the setpoint
    assert controller_status(running)["Saturations"] > 0
    running.periods(99)
    counted = controller_status(running)["Saturations"]
    record = running.controller.record.columns_by_name()
    flags = record["flags"][record["state"] == State.RUN]  # the position stays: it does not run to the end
    assert counted == (flags & FLAG_SPEED_LIMITED).sum() > 1


def test_the_count_of_limited_periods_stops_at_its_largest():
    words, state, io = [0] * at.TASK_SIZE, [0] * k.ST_SIZE, [0] * k.IO_SIZE
    mailboxes, calibration = [0] * at.MAILBOXES_SIZE, list(Tuning().calibration().words)
    mailboxes[at.COMMAND_LAW], calibration[k.CAL_U_LIMIT] = LAW_PI, 1
    mailboxes[at.SETPOINT_POSITION] = 4_000_000
    words[at.SATURATIONS] = at.COUNT_MAX - 1
    counts = []
    for _ in range(3):
        task.control(mailboxes, words, calibration, state, io, int(not counts))
        counts.append(words[at.SATURATIONS])
    assert counts == [at.COUNT_MAX] * 3


# integers only


SOURCES = (firmware_py.node, firmware_py.answer, firmware_py.entry_points, firmware_py.contract_words)


def test_all_it_sends_is_made_of_plain_integers(running):
    set_inputs(running, setpoint_0p1um=10 * POSITION_UM + 1000)
    for _ in range(110):
        running.period()
        for send_ns, frame in running.sent:
            assert {type(value) for value in (send_ns, *frame)} == {int}
    record = running.controller.record.columns_by_name()
    assert {column.dtype.kind for column in record.values()} == {"i"}


@pytest.mark.parametrize("module", SOURCES, ids=lambda m: m.__name__)
def test_the_sources_know_no_floats(module):
    for node in ast.walk(ast.parse(Path(module.__file__).read_text())):
        assert not (isinstance(node, ast.Constant) and isinstance(node.value, float | complex))
        assert not isinstance(getattr(node, "op", None), ast.Div)
        assert not (isinstance(node, ast.Name) and node.id in ("float", "math", "round"))
