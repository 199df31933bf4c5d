"""Length of frames on the wire, against vectors and an independent bit-by-bit encoder."""

import can
import numpy as np
import pytest
from bit_by_bit import bit_columns, crc15, reference_bits, stuff_bits
from hypothesis import given
from hypothesis import strategies as st

from dbc.frame import EFF_FLAG
from hil.bus.wire_time import RTR_FLAG, classic_bits, fd_bits, frame_bits

STANDARD_IDS = st.integers(0, (1 << 11) - 1)
EXTENDED_IDS = st.integers(0, (1 << 29) - 1)
LONG_RUNS = st.lists(st.sampled_from([0x00, 0x01, 0x0F, 0x1F, 0x55, 0x80, 0xF0, 0xF8, 0xFF]), max_size=8).map(
    bytes
)
PAYLOADS = st.binary(max_size=8) | LONG_RUNS


def message(arbitration_id, data=b"", extended=False, **kwargs):
    return can.Message(
        arbitration_id=arbitration_id, is_extended_id=extended, data=data, check=True, **kwargs
    )


@pytest.mark.parametrize(
    ("frame", "bits"),
    [
        (message(0x123, bytes(8)), 125),
        (message(0x7FF, b"\xff" * 8), 126),
        (message(0x555, b"\x55" * 8), 112),
        (message(0x000), 53),
        (message(0x101, bytes(range(1, 9))), 121),
        (message(0x1FFFFFFF, b"\xff" * 8, extended=True), 149),
        (message(0, bytes(8), extended=True), 150),
    ],
)
def test_classic_frame_length(frame, bits):
    assert frame_bits(frame) == bits


@pytest.mark.parametrize(("length", "nominal", "fast"), [(8, 29, 97), (16, 29, 161), (64, 29, 550)])
def test_fd_frame_length_per_bit_rate(length, nominal, fast):
    frame = message(0x555, b"\x55" * length, is_fd=True, bitrate_switch=True)
    assert fd_bits(frame) == (nominal, fast)
    assert frame_bits(frame) == nominal + fast


def test_without_bit_rate_switch_an_fd_frame_is_nominal_throughout():
    assert fd_bits(message(0x555, b"\x55" * 8, is_fd=True)) == (29 + 97, 0)


def test_fd_payloads_are_filled_up_to_the_next_length():
    assert fd_bits(message(0x555, b"\x55" * 9, is_fd=True)) == fd_bits(
        message(0x555, b"\x55" * 9 + bytes(3), is_fd=True)
    )


def test_five_equal_bits_at_the_end_of_fd_data_get_the_fixed_stuff_bit_only():
    *_, without = fd_bits(message(0x555, b"\x55" * 7 + b"\x50", is_fd=True, bitrate_switch=True))
    *_, ending_in_five = fd_bits(message(0x555, b"\x55" * 7 + b"\x60", is_fd=True, bitrate_switch=True))
    assert ending_in_five == without


def test_an_error_frame_has_no_length():
    with pytest.raises(ValueError, match="error frame"):
        frame_bits(can.Message(is_error_frame=True))


@given(STANDARD_IDS, PAYLOADS)
def test_standard_frame_stays_within_the_worst_case(arbitration_id, data):
    length = len(data)
    assert 47 + 8 * length <= frame_bits(message(arbitration_id, data)) <= 55 + 10 * length


@given(EXTENDED_IDS, PAYLOADS)
def test_extended_frame_stays_within_the_worst_case(arbitration_id, data):
    length = len(data)
    bits = frame_bits(message(arbitration_id, data, extended=True))
    assert 67 + 8 * length <= bits <= 80 + 10 * length


@given(STANDARD_IDS, st.integers(0, 8))
def test_remote_frame_carries_its_length_code_but_no_data(arbitration_id, dlc):
    frame = message(arbitration_id, is_remote_frame=True, dlc=dlc)
    assert frame_bits(frame) == classic_bits(arbitration_id | RTR_FLAG, dlc, 0)
    assert 47 <= frame_bits(frame) <= 55


@given(EXTENDED_IDS, PAYLOADS)
def test_messages_and_light_frames_are_equally_long(arbitration_id, data):
    light = classic_bits(arbitration_id | EFF_FLAG, len(data), int.from_bytes(data, "little"))
    assert light == frame_bits(message(arbitration_id, data, extended=True))


@given(STANDARD_IDS, PAYLOADS, st.booleans())
def test_interpreted_and_compiled_code_agree(arbitration_id, data, remote):
    can_id = arbitration_id | (RTR_FLAG if remote else 0)
    payload = np.uint64(int.from_bytes(data, "little"))
    assert classic_bits.py_func(can_id, len(data), payload) == classic_bits(can_id, len(data), payload)


def test_reference_crc_meets_its_published_check_value():
    bits = [int(bit) for byte in b"123456789" for bit in f"{byte:08b}"]
    assert crc15([np.array([bit], dtype=np.uint64) for bit in bits]) == 0x059E


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("dlc", range(9))
def test_random_frames_are_as_long_as_the_reference_says(dlc, extended):
    """18 x 6000 frames; half of the payloads are sparse or dense, so that many bits get stuffed."""
    rng = np.random.default_rng(dlc + 10 * extended)
    identifiers = rng.integers(0, 1 << (29 if extended else 11), 6000, dtype=np.uint64)
    payloads, mask = rng.integers(0, 1 << 64, (2, 6000), dtype=np.uint64)
    payloads[:1500] &= mask[:1500] & mask[1500:3000]
    payloads[1500:3000] |= mask[:1500] | mask[1500:3000]
    flag = EFF_FLAG if extended else 0
    bits = [
        classic_bits(can_id | flag, dlc, payload)
        for can_id, payload in zip(identifiers.tolist(), payloads.tolist(), strict=True)
    ]
    assert np.array_equal(bits, reference_bits(identifiers, extended, dlc, payloads))


@given(
    st.booleans().flatmap(
        lambda extended: st.tuples(st.just(extended), EXTENDED_IDS if extended else STANDARD_IDS)
    ),
    st.sampled_from(sorted(can.util.CAN_FD_DLC)).flatmap(
        lambda length: st.lists(
            st.sampled_from([0x00, 0x1F, 0x55, 0x60, 0xF8, 0xFF]), min_size=length, max_size=length
        )
    ),
    st.booleans(),
)
def test_fd_frames_are_as_long_as_the_reference_says(identifier, data, error_passive):
    extended, arbitration_id = identifier
    frame = message(
        arbitration_id,
        bytes(data),
        extended,
        is_fd=True,
        bitrate_switch=True,
        error_state_indicator=error_passive,
    )
    assert fd_bits(frame) == reference_fd_bits(frame)


def reference_fd_bits(frame):
    """Nominal and fast bits, built from the fields of the standard."""
    identifier = np.array([frame.arbitration_id], dtype=np.uint64)
    zero, one = np.zeros_like(identifier), np.ones_like(identifier)
    if frame.is_extended_id:
        base, extension = identifier >> np.uint64(18), identifier & np.uint64(0x3FFFF)
        nominal = [zero, *bit_columns(base, 11), one, one, *bit_columns(extension, 18), zero, one, zero, one]
    else:
        nominal = [zero, *bit_columns(identifier, 11), zero, zero, one, zero, one]
    esi = one if frame.error_state_indicator else zero
    length_code = bit_columns(np.full_like(identifier, can.util.CAN_FD_DLC.index(len(frame.data))), 4)
    data = [column for byte in frame.data for column in bit_columns(np.full_like(identifier, byte), 8)]
    stuffable = [*nominal, esi, *length_code, *data[:-1]] if data else [*nominal, esi, *length_code[:-1]]
    crc_field = 4 + 17 + 6 if len(frame.data) <= 16 else 4 + 21 + 7
    nominal_stuff_bits = stuff_bits(nominal)[0]
    fast_stuff_bits = stuff_bits(stuffable)[0] - nominal_stuff_bits
    return (
        len(nominal) + nominal_stuff_bits + 12,
        5 + 8 * len(frame.data) + fast_stuff_bits + crc_field + 1,
    )
