"""The packaged DBC file as tools outside see it."""

import cantools
import pytest

from dbc.codec import signal_name
from dbc.contract import PACKAGED_DBC
from dbc.messages import BenchCommand, BenchFault, BenchParameter

DATABASE = cantools.database.load_file(PACKAGED_DBC, strict=True)
MESSAGES = {message.name: message for message in DATABASE.messages}
SIGNALS = {
    f"{message.name}.{signal.name}": (message, signal)
    for message in DATABASE.messages
    for signal in message.signals
}
IN_BAND = [message for message in DATABASE.messages if not message.is_extended_frame]

every_message = pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES.keys())
every_signal = pytest.mark.parametrize(("message", "signal"), SIGNALS.values(), ids=SIGNALS.keys())


def test_identifiers_and_lengths_are_the_published_ones():
    assert {message.name: (message.frame_id, message.length) for message in DATABASE.messages} == {
        "DriveCommand": (0x100, 6),
        "PositionFeedback": (0x110, 6),
        "PositionSetpoint": (0x120, 6),
        "ControllerCommand": (0x140, 3),
        "DriveStatus": (0x180, 6),
        "PressureFeedback": (0x190, 6),
        "ControllerStatus": (0x300, 8),
        "ObserverState": (0x600, 8),
        "BenchControl": (0x1FFF0001, 8),
        "BenchLoad": (0x1FFF0002, 4),
    }


def test_cycle_times_are_the_published_ones():
    assert {message.name: message.cycle_time for message in DATABASE.messages} == {
        "DriveCommand": 1,
        "PositionFeedback": 1,
        "PositionSetpoint": 1,
        "ControllerCommand": 100,
        "DriveStatus": 10,
        "PressureFeedback": 10,
        "ControllerStatus": 100,
        "ObserverState": 10,
        "BenchControl": None,
        "BenchLoad": None,
    }


def test_bus_is_classic_can_at_1_mbit_per_s():
    assert DATABASE.dbc.attributes["BusType"].value == "CAN"
    assert DATABASE.dbc.attributes["Baudrate"].value == 1_000_000


def test_worst_case_load_at_500_kbit_per_s_stays_below_85_percent():
    worst_case_bits_per_s = sum((55 + 10 * message.length) * 1000 / message.cycle_time for message in IN_BAND)
    assert worst_case_bits_per_s / 500_000 < 0.85


def test_network_management_and_diagnostics_keep_their_identifiers():
    reserved = {0x000, 0x080, *range(0x700, 0x800)}
    assert reserved.isdisjoint(message.frame_id for message in IN_BAND)


@every_message
def test_message_is_described(message):
    assert message.comment
    assert len(message.senders) == 1
    assert message.receivers
    assert "GenMsgCycleTime" in message.dbc.attributes
    assert "GenMsgSendType" in message.dbc.attributes
    expected_format = "ExtendedCAN" if message.is_extended_frame else "StandardCAN"
    assert message.dbc.attributes["VFrameFormat"].value == ["StandardCAN", "ExtendedCAN"].index(
        expected_format
    )


@every_message
def test_sends_cyclically_or_on_events(message):
    assert (message.send_type == "Event") == (message.cycle_time is None)


@every_message
def test_29_bit_messages_are_the_bench_channel(message):
    out_of_band = message.dbc.attributes.get("BenchChannel")
    assert (out_of_band is not None and out_of_band.value == 1) == message.is_extended_frame


@every_signal
def test_signal_is_described(message, signal):
    assert signal.comment
    assert signal.byte_order == "little_endian"
    assert signal.receivers
    assert message.senders[0] not in signal.receivers
    assert "GenSigStartValue" in signal.dbc.attributes


@every_signal
def test_scaled_signal_has_a_unit(message, signal):
    dimension_varies = signal.name in {"FaultValue", "ParameterScale"}
    assert signal.unit or signal.scale == 1 or dimension_varies


@every_signal
def test_range_holds_the_start_value_and_fits_the_raw_bits(message, signal):
    lowest_raw = -(1 << signal.length - 1) if signal.is_signed else 0
    highest_raw = lowest_raw + (1 << signal.length) - 1
    assert signal.minimum <= signal.raw_initial * signal.scale <= signal.maximum
    assert lowest_raw * signal.scale <= signal.minimum * (1 - 1e-12)
    assert signal.maximum * (1 - 1e-12) <= highest_raw * signal.scale


@pytest.mark.parametrize(
    "name", ["DriveCommand", "PositionFeedback", "PositionSetpoint", "ControllerCommand", "DriveStatus"]
)
def test_protected_message_has_its_crc_and_counter_where_profile_2_wants_them(name):
    crc = MESSAGES[name].get_signal_by_name("Crc")
    counter = MESSAGES[name].get_signal_by_name("Counter")
    assert (crc.start, crc.length) == (0, 8)
    assert (counter.start, counter.length) == (8, 4)


def test_states_have_names():
    assert dict(MESSAGES["ControllerStatus"].get_signal_by_name("State").choices) == {
        0: "PowerOn",
        1: "Standby",
        2: "Run",
        3: "Safe",
    }


@pytest.mark.parametrize(
    ("signal", "members"),
    [("Command", BenchCommand), ("FaultId", BenchFault), ("ParameterId", BenchParameter)],
)
def test_tools_outside_name_what_the_bench_asks_for_as_the_code_does(signal, members):
    assert dict(MESSAGES["BenchControl"].get_signal_by_name(signal).choices) == {
        member.value: signal_name(member.name.lower()) for member in members
    }


@pytest.mark.parametrize(
    ("typed", "meaning"),
    [
        ("0200020040420F00", {"Command": "SetFault", "FaultId": "SensorBias", "FaultValue": 1.0}),
        (
            "0300010020A10700",
            {"Command": "ScaleParameter", "ParameterId": "BulkModulus", "ParameterScale": 0.5},
        ),
    ],
)
def test_a_fault_can_be_typed_by_hand(typed, meaning):
    """``cansend can0 1FFF0001#0300010020A10700`` halves the oil's stiffness."""
    assert MESSAGES["BenchControl"].decode(bytes.fromhex(typed)) == meaning


@pytest.mark.parametrize(
    ("page", "signal", "raw", "si"),
    [
        (0, "TdPosition", 1 << 30, 0.5),
        (1, "TdVelocity", 1 << 30, 1e3 * 2.0**-8),
        (2, "TdAcceleration", 1 << 30, 1e6 * 2.0**-10),
        (3, "EsoPosition", -(1 << 30), -0.5),
        (4, "EsoVelocity", 1 << 30, 1e3 * 2.0**-8),
        (5, "EsoAcceleration", 1 << 30, 1e6 * 2.0**-10),
        (6, "EsoDisturbance", 1 << 30, 1e9 * 2.0**-12),
    ],
)
def test_observer_state_shows_si_units(page, signal, raw, si):
    payload = bytes([page, 0, 7, 0]) + raw.to_bytes(4, "little", signed=True)
    decoded = MESSAGES["ObserverState"].decode(payload, decode_choices=False)
    assert decoded == {"Page": page, "Cycle": 7, signal: pytest.approx(si, rel=1e-12)}


def test_a_load_can_be_typed_by_hand():
    """``cansend can0 1FFF0002#D0070000`` pushes with 2 kN."""
    assert MESSAGES["BenchLoad"].decode(bytes.fromhex("D0070000")) == {"Force": 2000}
