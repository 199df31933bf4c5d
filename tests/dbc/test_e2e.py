"""End-to-end protection, profile 2: the CRC, the sender, and the receiver's statuses."""

import pytest
from cantools.autosar import compute_profile2_crc
from hypothesis import example, given
from hypothesis import strategies as st

from dbc import profile2
from dbc.contract import Contract
from dbc.e2e import ACCEPTED, Checker, Protector, Status, profile2_crc, receiver_configuration

DATA_IDS = Contract.load().drive_command.data_ids
DLC = 6

OK = Status.OK
NONEWDATA = Status.NONEWDATA
WRONGCRC = Status.WRONGCRC
SYNC = Status.SYNC
INITIAL = Status.INITIAL
REPEATED = Status.REPEATED
OKSOMELOST = Status.OKSOMELOST
WRONGSEQUENCE = Status.WRONGSEQUENCE

CORRUPT = "corrupt"
NOTHING = None


def frame(counter, data=0x1234_5678_0000, dlc=DLC):
    """A protected payload with a counter of our choice."""
    data = data & ~0xFFF | counter << 8
    return data | profile2_crc(data, dlc, DATA_IDS[counter])


def statuses(events, **configuration):
    """Run a receiver over counters, NOTHING and CORRUPT frames."""
    checker = Checker(DATA_IDS, DLC, **configuration)
    received = {NOTHING: None, CORRUPT: frame(3) ^ 1 << 20}
    return [checker.check(received[event] if event in received else frame(event)) for event in events]


@pytest.mark.parametrize(
    ("hex_bytes", "crc"),
    [
        ("00000000", 0x12),
        ("F20183", 0xC2),
        ("0FAA0055", 0xC6),
        ("00FF5511", 0x77),
        ("926B55", 0x33),
        ("FFFFFFFF", 0x6C),
    ],
)
def test_crc_meets_the_published_vectors(hex_bytes, crc):
    """Test vectors of the AUTOSAR CRC library specification for CRC8H2F, last byte taken as the DataID."""
    *payload, data_id = bytes.fromhex(hex_bytes)
    assert profile2_crc(int.from_bytes(bytes([0, *payload]), "little"), 1 + len(payload), data_id) == crc


@given(st.binary(min_size=2, max_size=8), st.integers(0, 255))
def test_crc_equals_that_of_cantools(payload, data_id):
    data = int.from_bytes(payload, "little")
    assert profile2_crc(data, len(payload), data_id) == compute_profile2_crc(payload, data_id)


@given(st.binary(min_size=2, max_size=8), st.integers(0, 255))
def test_interpreted_crc_equals_the_compiled_one(payload, data_id):
    data = int.from_bytes(payload, "little")
    arguments = data, len(payload), data_id
    assert profile2_crc.py_func(*arguments) == profile2_crc(*arguments)


@given(st.integers(0, (1 << 48) - 1))
def test_sender_counts_from_1_through_15_to_0_and_keeps_the_signals(data):
    protector = Protector(DATA_IDS, DLC)
    sent = [protector.protect(data) for _ in range(17)]
    assert [payload >> 8 & 15 for payload in sent] == [*range(1, 16), 0, 1]
    assert {payload >> 12 for payload in sent} == {data >> 12}


@given(st.integers(0, (1 << 48) - 1))
def test_what_the_sender_protects_the_receiver_accepts(data):
    protector, checker = Protector(DATA_IDS, DLC), Checker(DATA_IDS, DLC)
    received = [checker.check(protector.protect(data)) for _ in range(40)]
    assert received == [INITIAL] + 39 * [OK]


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        pytest.param([7, 8, 9], [INITIAL, OK, OK], id="any counter starts"),
        pytest.param([14, 15, 0, 1], [INITIAL, OK, OK, OK], id="counter wraps"),
        pytest.param([NOTHING, NOTHING, 4, 5], [NONEWDATA, NONEWDATA, INITIAL, OK], id="late start"),
        pytest.param([CORRUPT, 4, 5], [WRONGCRC, INITIAL, OK], id="corrupt start"),
        pytest.param([1, 1, 2], [INITIAL, REPEATED, OK], id="repeated"),
        pytest.param([1, 3, 4], [INITIAL, OKSOMELOST, OK], id="one lost"),
        pytest.param([1, 4, 5, 6], [INITIAL, WRONGSEQUENCE, SYNC, OK], id="two lost between two checks"),
        pytest.param([5, 4, 5, 6], [INITIAL, WRONGSEQUENCE, SYNC, OK], id="out of order"),
        pytest.param(
            [1, NOTHING, NOTHING, 4, 5],
            [INITIAL, NONEWDATA, NONEWDATA, OKSOMELOST, OK],
            id="each check without data tolerates one more loss",
        ),
        pytest.param(
            [1, CORRUPT, CORRUPT, 4, 5],
            [INITIAL, WRONGCRC, WRONGCRC, OKSOMELOST, OK],
            id="corrupt frames count as lost",
        ),
        pytest.param(
            [1, NOTHING, NOTHING, NOTHING, 2, 3],
            [INITIAL, NONEWDATA, NONEWDATA, NONEWDATA, OK, OK],
            id="silence up to the limit",
        ),
        pytest.param(
            [1, NOTHING, NOTHING, NOTHING, NOTHING, 6, 7, 8],
            [INITIAL, NONEWDATA, NONEWDATA, NONEWDATA, NONEWDATA, SYNC, SYNC, OK],
            id="silence beyond the limit",
        ),
        pytest.param(
            [1, 1, 1, 1, 1, 2, 3, 4],
            [INITIAL, REPEATED, REPEATED, REPEATED, REPEATED, SYNC, SYNC, OK],
            id="a sender stuck on one frame",
        ),
        pytest.param(
            [1, 9, 15, 0, 1],
            [INITIAL, WRONGSEQUENCE, WRONGSEQUENCE, SYNC, OK],
            id="a second jump starts the synchronisation anew",
        ),
        pytest.param([1, 1, 1, 1, 2], [INITIAL, *[REPEATED] * 3, OK], id="repetitions up to the limit"),
        pytest.param(
            [1, *[NOTHING] * 3, 2, *[NOTHING] * 3, 3],
            [INITIAL, *[NONEWDATA] * 3, OK, *[NONEWDATA] * 3, OK],
            id="valid data end a silence",
        ),
        pytest.param(
            [1, 2, *[NOTHING] * 4, 3, 4, 5],
            [INITIAL, OK, *[NONEWDATA] * 4, SYNC, SYNC, OK],
            id="silence beyond the limit after valid data",
        ),
        pytest.param(
            [1, *[NOTHING] * 4, 12, 13, 14],
            [INITIAL, *[NONEWDATA] * 4, WRONGSEQUENCE, SYNC, OK],
            id="a jump ends a silence",
        ),
        pytest.param(
            [1, 12, *[NOTHING] * 3, 13, 14],
            [INITIAL, WRONGSEQUENCE, *[NONEWDATA] * 3, SYNC, OK],
            id="silence up to the limit after a jump",
        ),
        pytest.param(
            [1, 12, *[NOTHING] * 4, 13, 14, 15],
            [INITIAL, WRONGSEQUENCE, *[NONEWDATA] * 4, SYNC, SYNC, OK],
            id="silence beyond the limit after a jump",
        ),
    ],
)
def test_receiver_status(events, expected):
    assert statuses(events) == expected


@pytest.mark.parametrize(("event", "status"), [(NOTHING, NONEWDATA), (1, REPEATED)])
def test_the_count_of_bad_checks_stops_at_15(event, status):
    """With a limit of 15 no silence and no repetition is ever too long."""
    events, expected = [1, *[event] * 20, 2], [INITIAL, *[status] * 20, OK]
    assert statuses(events, max_no_new_or_repeated_data=15) == expected
    expected[-1] = SYNC
    assert statuses(events, max_no_new_or_repeated_data=14) == expected


def test_all_bytes_are_data_ids():
    data_ids = [0, 255, *range(14)]
    protector, checker = Protector(data_ids, DLC), Checker(data_ids, DLC)
    assert [checker.check(protector.protect(0)) for _ in range(20)] == [INITIAL] + 19 * [OK]


def test_without_synchronisation_a_wrong_sequence_does_not_move_the_expected_counter():
    assert statuses([1, 9, 2, 3], sync_counter_init=0) == [INITIAL, WRONGSEQUENCE, OK, OK]


def test_longer_synchronisation_needs_more_valid_counters():
    assert statuses([1, 9, 10, 11, 12], sync_counter_init=2) == [INITIAL, WRONGSEQUENCE, SYNC, SYNC, OK]


def test_a_tolerant_receiver_accepts_larger_gaps():
    assert statuses([1, 6, 7], max_delta_counter_init=4) == [INITIAL, OKSOMELOST, OK]


def test_the_sizes_are_those_of_the_arrays():
    assert len(receiver_configuration(DATA_IDS, DLC)) == profile2.CONFIGURATION_SIZE
    names = ("NOT_FIRST", "LAST_VALID_COUNTER", "MAX_DELTA_COUNTER", "SYNC_COUNTER")
    names += ("NO_NEW_OR_REPEATED_DATA_COUNTER", "LOST_DATA", "STATE_SIZE")
    assert [getattr(profile2, name) for name in names] == list(range(7))


def in_words(payload):
    """A payload as restricted Python takes it: two signed 32-bit words."""
    return [(payload >> shift & 0xFFFF_FFFF ^ 1 << 31) - (1 << 31) for shift in (0, 32)]


@given(
    steps=st.lists(st.sampled_from([1, 1, 1, 1, 0, 2, 6, 9, NOTHING, CORRUPT]), max_size=60),
    limits=st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 2)),
)
@example(steps=[1, 9, 1, 1, 1, 1], limits=(1, 3, 2))
def test_state_and_configuration_may_lie_anywhere_among_other_words(steps, limits):
    counter, events = 0, []
    for step in steps:
        counter = counter + step & 15 if isinstance(step, int) else counter
        events.append(counter if isinstance(step, int) else step)
    names = ("max_delta_counter_init", "max_no_new_or_repeated_data", "sync_counter_init")
    expected = statuses(events, **dict(zip(names, limits, strict=True)))
    others = [99] * 32
    state = [*others, *[0] * profile2.STATE_SIZE, *others]
    configuration = [*others, *DATA_IDS, DLC, *limits, *others]
    received = {NOTHING: 0, CORRUPT: frame(3) ^ 1 << 20}
    payloads = [received[event] if event in received else frame(event) for event in events]
    found = [
        profile2.profile2_check(state, 32, configuration, 32, *in_words(payload), int(event is not NOTHING))
        for event, payload in zip(events, payloads, strict=True)
    ]
    assert found == expected
    assert state[:32] == state[-32:] == others
    for counter in range(16):
        low, high = in_words(frame(counter))
        assert profile2.profile2_protect(configuration, 32, counter, low | 0xFFF, high) == low


@pytest.mark.parametrize(
    ("status", "accepted"), [(status, status in (OK, SYNC, OKSOMELOST)) for status in Status]
)
def test_what_is_accepted(status, accepted):
    assert profile2.profile2_is_accepted(status) == accepted


def test_lost_messages_are_counted():
    checker = Checker(DATA_IDS, DLC, max_delta_counter_init=4)
    lost = []
    for counter in (1, 2, 5, 7, 8):
        checker.check(frame(counter))
        lost.append(checker.lost_data)
    assert lost == [0, 0, 2, 1, 0]


def test_only_fresh_data_in_sequence_may_be_used():
    assert [status for status in Status if status in ACCEPTED] == [OK, SYNC, OKSOMELOST]


def test_status_values_are_those_of_the_specification():
    assert {status.name: int(status) for status in Status} == {
        "OK": 0x00,
        "NONEWDATA": 0x01,
        "WRONGCRC": 0x02,
        "SYNC": 0x03,
        "INITIAL": 0x04,
        "REPEATED": 0x08,
        "OKSOMELOST": 0x20,
        "WRONGSEQUENCE": 0x40,
    }


@pytest.mark.parametrize("data_ids", [range(15), range(17), [*range(15), 256], [*range(15), -1]])
def test_a_list_of_other_than_16_byte_values_is_refused(data_ids):
    with pytest.raises(ValueError, match="profile 2 needs 16 DataIDs"):
        Protector(data_ids, DLC)
    with pytest.raises(ValueError, match="profile 2 needs 16 DataIDs"):
        Checker(data_ids, DLC)
