"""The generated integer codecs against cantools, and their behaviour at the limits."""

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbc.contract import Contract

CONTRACT = Contract.load()
DATABASE = cantools.database.load_file(CONTRACT.path)
OVERLAID = {
    ("ObserverState", "value"): (
        "TdPosition",
        "TdVelocity",
        "TdAcceleration",
        "EsoPosition",
        "EsoVelocity",
        "EsoAcceleration",
        "EsoDisturbance",
    ),
    ("BenchControl", "identifier"): ("FaultId", "ParameterId"),
    ("BenchControl", "value"): ("InitialPosition", "FaultValue", "ParameterScale"),
}
"""Signals that share a field; the multiplexer selects one of them."""

every_codec = pytest.mark.parametrize("codec", CONTRACT.messages, ids=lambda codec: codec.name)


def signals_of(codec, field):
    camel_case = "".join(part.capitalize() for part in field.split("_"))
    names = OVERLAID.get((codec.name, field), (camel_case,))
    return [DATABASE.get_message_by_name(codec.name).get_signal_by_name(name) for name in names]


def raw_range(signal):
    lowest = -(1 << signal.length - 1) if signal.is_signed else 0
    return lowest, lowest + (1 << signal.length) - 1


@st.composite
def signal_values(draw, codec):
    """Draw raw values over the whole range of every signal: (per field, per DBC signal on the page)."""
    fields = {}
    signals = {}
    page = None
    for field in codec.unpack(0)._fields:
        candidates = signals_of(codec, field)
        selected = [s for s in candidates if s.multiplexer_ids is None or page in s.multiplexer_ids]
        raw = draw(st.integers(*raw_range(selected[0]))) if selected else 0
        if candidates[0].is_multiplexer:
            raw = page = draw(st.sampled_from(sorted(candidates[0].choices)))
        fields[field] = raw
        signals |= {signal.name: raw for signal in selected}
    return fields, signals


@every_codec
@given(data=st.data())
def test_pack_equals_cantools_encode(codec, data):
    fields, signals = data.draw(signal_values(codec))
    unprotected = {"Crc": 0, "Counter": 0} if codec.data_ids else {}
    expected = DATABASE.encode_message(codec.name, signals | unprotected, scaling=False, strict=False)
    assert codec.pack(**fields).to_bytes(codec.dlc, "little") == expected


@every_codec
@given(data=st.data())
def test_unpack_equals_cantools_decode(codec, data):
    noise = data.draw(st.integers(0, (1 << 8 * codec.dlc) - 1))
    fields = codec.unpack(noise)._asdict()
    multiplexer = next((field for field in fields if signals_of(codec, field)[0].is_multiplexer), None)
    if multiplexer is not None:
        page = data.draw(st.sampled_from(sorted(signals_of(codec, multiplexer)[0].choices)))
        noise = noise & ~0xFF | page
        fields = codec.unpack(noise)._asdict()
    payload = noise.to_bytes(codec.dlc, "little")
    decoded = DATABASE.decode_message(codec.name, payload, decode_choices=False, scaling=False)
    by_signal = {signal.name: raw for field, raw in fields.items() for signal in signals_of(codec, field)}
    assert {name: by_signal[name] for name in decoded if name not in ("Crc", "Counter")} == {
        name: raw for name, raw in decoded.items() if name not in ("Crc", "Counter")
    }


@every_codec
@given(data=st.data())
def test_unpack_restores_what_was_packed(codec, data):
    fields, _ = data.draw(signal_values(codec))
    assert codec.unpack(codec.pack(**fields)) == tuple(fields.values())


@every_codec
def test_a_value_beyond_its_signal_is_refused(codec):
    at_rest = codec.unpack(0)
    for field in at_rest._fields:
        lowest, highest = raw_range(signals_of(codec, field)[0])
        for beyond in (lowest - 1, highest + 1):
            with pytest.raises(OverflowError, match=f"{codec.name}: {field} = {beyond} exceeds"):
                codec.pack(*at_rest._replace(**{field: beyond}))


def test_a_numpy_scalar_is_refused_since_its_shifts_lose_bits():
    with pytest.raises(TypeError, match="DriveCommand: target_velocity is a int32, pass an int"):
        CONTRACT.drive_command.pack(15, np.int32(1200))


def test_crc_and_counter_are_left_to_the_protection():
    assert CONTRACT.drive_command.pack(controlword=0xFFFF, target_velocity=-1) & 0xFFF == 0
    assert CONTRACT.drive_command.unpack(0xFFF) == (0, 0)
