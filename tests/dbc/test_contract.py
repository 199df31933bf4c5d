"""What loading a contract guarantees, and what it says when the file falls short."""

import pytest

from dbc.contract import PACKAGED_DBC, Contract, ContractError
from dbc.frame import EFF_FLAG


@pytest.fixture
def load_changed(tmp_path):
    """Load the packaged contract with some text replaced."""

    def load(*replacements):
        text = PACKAGED_DBC.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "own.dbc"
        path.write_text(text)
        return Contract.load(path)

    return load


def test_packaged_contract_is_the_default():
    contract = Contract.load()
    assert contract.path == PACKAGED_DBC
    assert contract.bitrate == 1_000_000
    assert contract.drive_command.can_id == 0x100
    assert contract.drive_command.dlc == 6
    assert contract.drive_command.cycle_time_ns == 1_000_000
    assert not contract.drive_command.bench_channel


def test_messages_come_in_order_of_priority():
    names = [message.name for message in Contract.load().messages]
    assert names == [
        "DriveCommand",
        "PositionFeedback",
        "PositionSetpoint",
        "ControllerCommand",
        "DriveStatus",
        "PressureFeedback",
        "ControllerStatus",
        "ObserverState",
        "BenchControl",
        "BenchLoad",
    ]


def test_bench_messages_have_29_bit_identifiers_and_no_cycle():
    bench_load = Contract.load().bench_load
    assert bench_load.can_id == 0x1FFF0002 | EFF_FLAG
    assert bench_load.bench_channel
    assert bench_load.cycle_time_ns == 0


def test_exactly_the_safety_related_messages_are_protected():
    protected = {message.name for message in Contract.load().messages if message.data_ids}
    assert protected == {
        "DriveCommand",
        "PositionFeedback",
        "PositionSetpoint",
        "ControllerCommand",
        "DriveStatus",
    }


def test_signals_carry_what_tools_need_for_physical_values():
    velocity = Contract.load().drive_command.signals["TargetVelocity"]
    assert (velocity.factor, velocity.offset, velocity.unit) == (0.25, 0, "rpm")
    assert (velocity.minimum, velocity.maximum) == (-4000, 4000)


def test_value_tables_are_readable():
    assert Contract.load().controller_status.signals["State"].choices[3] == "Safe"


def test_an_own_file_may_move_messages_and_signals(load_changed):
    contract = load_changed(
        ("256", "80"),
        ("Controlword : 16|16", "Controlword : 32|16"),
        ("TargetVelocity : 32|16", "TargetVelocity : 16|16"),
    )
    assert contract.drive_command.can_id == 80
    assert contract.drive_command.pack(controlword=0x000F, target_velocity=0x1234) == 0x000F_1234_0000


def test_an_own_file_may_add_signals(load_changed):
    contract = load_changed(
        (" SG_ Statusword", ' SG_ Temperature : 12|4@1+ (10,0) [0|150] "degC" Controller\n SG_ Statusword')
    )
    assert contract.drive_status.unpack(0x0000_0237_7000) == (0x0237, 0)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (" DriveCommand:", " SpeedCommand:", "message DriveCommand is missing"),
        (" TargetVelocity :", " Speed :", "message DriveCommand: signal TargetVelocity is missing"),
        (
            "Position : 16|32@1- (1e-06",
            "Position : 16|24@1- (1e-06",
            "must be a little-endian 32-bit signed integer",
        ),
        (
            "ActualVelocity : 32|16@1-",
            "ActualVelocity : 32|16@1+",
            "must be a little-endian 16-bit signed integer",
        ),
        ("PressureB : 16|16@1+", "PressureB : 23|16@0+", "signal PressureB must be a little-endian"),
        ("(1e-06,0) [-0.999", "(1e-06,0.1) [-0.999", "without offset"),
        (
            "TargetVelocity : 32|16@1- (0.25",
            "TargetVelocity : 32|16@1- (0.5",
            "must have factor 0.25, not 0.5",
        ),
        ("EsoPosition m3", "EsoPosition m9", "signal EsoPosition must be page m3"),
        (
            "SG_ Statusword :",
            'SG_ Page M : 12|4@1+ (1,0) [0|15] "" Controller\n SG_ Statusword m0 :',
            "signal Statusword must not be multiplexed",
        ),
        ("ParameterId m3 : 16|16", "ParameterId m3 : 8|16", "signal ParameterId must lie on FaultId"),
        ("Crc : 0|8@1+", "Crc : 40|8@1+", "not a valid DBC"),
        (
            'Counter : 8|4@1+ (1,0) [0|15] "" Drive\n',
            'Counter : 12|4@1+ (1,0) [0|15] "" Drive\n',
            "message DriveCommand: signal Counter must start at bit 8",
        ),
        ('"12,27,77,', '"12,27,', "E2EProfile2DataIdList must list 16 numbers of 0..255"),
        ('"12,27,77,', '"12,270,77,', "E2EProfile2DataIdList must list 16 numbers of 0..255"),
        (
            'BA_ "GenMsgCycleTime" BO_ 400 10;',
            "",
            "message PressureFeedback: attribute GenMsgCycleTime is missing",
        ),
        ('BA_ "Baudrate" 1000000;', "", "attribute Baudrate is missing"),
        ("BO_ 400 PressureFeedback: 6", "BO_ 400 PressureFeedback: 12", "must have at most 8 bytes"),
        ("BO_ 256", "BO_ two hundred", "not a valid DBC"),
    ],
)
def test_a_file_that_falls_short_is_refused_in_one_helpful_line(load_changed, old, new, complaint):
    with pytest.raises(ContractError) as refusal:
        load_changed((old, new))
    message = str(refusal.value)
    assert "own.dbc: " in message
    assert complaint in message
    assert message.endswith("or use the packaged ddh.dbc")
    assert "\n" not in message


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ContractError, match=r"nowhere\.dbc: cannot be read"):
        Contract.load(tmp_path / "nowhere.dbc")


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "picture.dbc"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ContractError, match=r"picture\.dbc: "):
        Contract.load(path)
