"""Length of frames on the wire, against vectors and an independent bit-by-bit encoder."""

import can
import numpy as np
import pytest
from bit_by_bit import crc15, reference_bits, reference_fd_bits
from can.util import CAN_FD_DLC
from hypothesis import given
from hypothesis import strategies as st

from dbc.frame import BRS_FLAG, EFF_FLAG, ESI_FLAG
from hil.bus.messages import to_frame
from hil.bus.wire_time import RTR_FLAG, classic_bits, fd_bits, frame_bits, payload_words

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


def lengths_of(message):
    """Bits at the nominal and at the data rate."""
    can_id, length, data = to_frame(message)
    return fd_bits(can_id, length, payload_words(data))


@pytest.mark.parametrize(("length", "nominal", "fast"), [(8, 29, 97), (16, 29, 161), (64, 29, 550)])
def test_fd_frame_length_per_bit_rate(length, nominal, fast):
    frame = message(0x555, b"\x55" * length, is_fd=True, bitrate_switch=True)
    assert lengths_of(frame) == (nominal, fast)
    assert frame_bits(frame) == nominal + fast


def test_without_bit_rate_switch_an_fd_frame_is_nominal_throughout():
    assert lengths_of(message(0x555, b"\x55" * 8, is_fd=True)) == (29 + 97, 0)


def test_fd_payloads_are_filled_up_to_the_next_length():
    frame, filled_up = (
        message(0x555, b"\x55" * 9 + fill, is_fd=True, bitrate_switch=True) for fill in (b"", bytes(3))
    )
    assert lengths_of(frame) == lengths_of(filled_up)
    assert frame_bits(frame) == frame_bits(filled_up)


def test_five_equal_bits_at_the_end_of_fd_data_get_the_fixed_stuff_bit_only():
    *_, without = lengths_of(message(0x555, b"\x55" * 7 + b"\x50", is_fd=True, bitrate_switch=True))
    *_, ending_in_five = lengths_of(message(0x555, b"\x55" * 7 + b"\x60", is_fd=True, bitrate_switch=True))
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


FD_PAYLOADS = st.sampled_from(CAN_FD_DLC).flatmap(
    lambda length: (
        st.binary(min_size=length, max_size=length)
        | st.lists(
            st.sampled_from([0x00, 0x1F, 0x55, 0x60, 0xF8, 0xFF]), min_size=length, max_size=length
        ).map(bytes)
    )
)


@given(STANDARD_IDS, EXTENDED_IDS, FD_PAYLOADS, st.booleans(), st.booleans(), st.booleans())
def test_fd_frames_are_as_long_as_bit_strings_say(base, identifier, data, extended, passive, switched):
    frame = message(
        identifier if extended else base,
        data,
        extended,
        is_fd=True,
        bitrate_switch=switched,
        error_state_indicator=passive,
    )
    assert lengths_of(frame) == fd_bits_by_string(frame)
    can_id, length, data = to_frame(frame)
    assert fd_bits.py_func(can_id, length, payload_words(data)) == lengths_of(frame)


@pytest.mark.parametrize("switched", [True, False], ids=["BRS", "no BRS"])
@pytest.mark.parametrize("extended", [False, True], ids=["11 bit", "29 bit"])
def test_random_fd_frames_are_as_long_as_the_reference_says(extended, switched):
    """2 x 2 x 16 x 400 frames; half of the payloads are sparse or dense, so that many bits get stuffed."""
    rng = np.random.default_rng(2 * extended + switched)
    for length in CAN_FD_DLC:
        identifiers = rng.integers(0, 1 << (29 if extended else 11), 400, dtype=np.uint64)
        passive = rng.integers(0, 2, 400, dtype=np.uint64)
        data = rng.integers(0, 256, (400, length), dtype=np.uint8)
        mask = rng.integers(0, 256, (2, 400, length), dtype=np.uint8)
        data[:100] &= mask[0, :100] & mask[1, :100]
        data[100:200] |= mask[0, 100:200] | mask[1, 100:200]
        nominal, fast = reference_fd_bits(identifiers, extended, switched, passive, data)
        expected = np.column_stack([nominal, fast] if switched else [nominal + fast, 0 * fast])
        flags = (EFF_FLAG if extended else 0) | (BRS_FLAG if switched else 0)
        lengths = [
            fd_bits(can_id | flags | esi * ESI_FLAG, length, payload_words(int.from_bytes(row, "little")))
            for can_id, esi, row in zip(identifiers.tolist(), passive.tolist(), data, strict=True)
        ]
        assert np.array_equal(lengths, expected)


def fd_bits_by_string(frame):
    """Nominal and fast bits of one frame, from the characters of its fields (ISO 11898-1)."""
    if frame.is_extended_id:
        identifier = f"{frame.arbitration_id >> 18:011b}11{frame.arbitration_id & 0x3FFFF:018b}0"
    else:
        identifier = f"{frame.arbitration_id:011b}00"
    before = f"0{identifier}10{frame.bitrate_switch:b}"
    code = CAN_FD_DLC.index(len(frame.data))
    after = f"{frame.error_state_indicator:b}{code:04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    stuffed = before + after
    at, on_wire, run = 0, "", ""
    switch = None
    while at < len(stuffed):
        on_wire += stuffed[at]
        run = run + stuffed[at] if run.endswith(stuffed[at]) else stuffed[at]
        at += 1
        if len(run) == 5 and at < len(stuffed):
            run = "0" if run[0] == "1" else "1"
            on_wire += run
        if at == len(before):
            switch = len(on_wire)
    crc_field = 4 + 17 + 6 if len(frame.data) <= 16 else 4 + 21 + 7
    nominal, fast = switch + 12, len(on_wire) - switch + crc_field + 1
    return (nominal, fast) if frame.bitrate_switch else (nominal + fast, 0)
