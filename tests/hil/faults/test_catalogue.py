"""Faults as objects, texts and tables: what they may be, and that nothing is lost on the way."""

import math
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbc.contract import Contract
from hil import cli
from hil.faults.catalogue import KINDS, fault_of, fault_of_table, fault_of_text, rows
from hil.faults.fault import FaultError
from hil.faults.names import PROTECTED, messages, signals

CONTRACT = Contract.load()


@st.composite
def any_fault(draw):
    kind = draw(st.sampled_from(sorted(KINDS)))
    parameters = {}
    for item in fields(KINDS[kind]):
        if item.name == "signal":
            parameters["signal"] = draw(st.sampled_from(signals(parameters["message"])))
        elif choices := item.metadata.get("choices"):
            parameters[item.name] = draw(st.sampled_from(choices))
        else:
            low, high = item.metadata["bounds"]
            numbers = st.integers if item.type is int else st.floats
            parameters[item.name] = draw(numbers(low, 3600.0 if high == math.inf else high))
    if kind == "random_signal":
        parameters["high"] = max(parameters["high"], parameters["low"])
    if kind == "load_impulse":
        parameters["impulse_n_s"] *= parameters["duration_s"] / 0.1
    return fault_of(kind, parameters)


@given(any_fault())
def test_text_and_table_say_all_of_a_fault(fault):
    assert fault_of_text(fault.text) == fault
    assert fault_of_table(fault.table) == fault


@given(any_fault())
def test_a_fault_does_not_change(fault):
    with pytest.raises(FrozenInstanceError):
        fault.at_s = 1.0
    assert not hasattr(fault, "__dict__")


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_is_bounded_and_has_its_unit_in_its_name(kind):
    for item in fields(KINDS[kind]):
        if bounds := item.metadata.get("bounds"):
            assert bounds[0] < bounds[1]
            for suffix, unit in (("_s", "s"), ("_us", "µs"), ("_m", "m"), ("_n", "N"), ("_ppm", "ppm")):
                if item.metadata["unit"] == unit:
                    assert item.name.endswith(suffix)
        else:
            assert item.metadata.keys() & {"choices", "name"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "there is no fault '': choose one of drop, delay"),
        ("bias", "there is no fault 'bias'"),
        ("sensor_bias", "bias_m is missing, must be a number from -1 to 1 m"),
        ("sensor_bias,bias_m", "is not of the form KIND,KEY=VALUE,KEY=VALUE, each key once"),
        ("sensor_bias,bias_m=1,bias_m=1", "each key once"),
        ("sensor_bias,bias_m=2", "bias_m is 2, must be a number from -1 to 1 m"),
        ("sensor_bias,bias_m=nan", "bias_m is nan"),
        ("sensor_bias,bias_m=x", "bias_m is 'x'"),
        ("sensor_bias,bias_m=0,at_s=-1", "at_s is -1, must be a number from 0 to 3600 s"),
        ("sensor_bias,bias_m=0,duration_s=0", "duration_s is 0, must be a number from 0.001 s on"),
        ("sensor_bias,bias_m=0,count=1", "there is no 'count', only at_s, duration_s, bias_m"),
        ("drop,message=3", "message is 3, must be one of DriveCommand"),
        ("drop,message=DriveCommand,count=0", "count is 0, must be a whole number from 1 to 1000000 frames"),
        ("wrong_crc,message=PressureFeedback", "message is 'PressureFeedback', must be one of DriveCommand"),
        (
            "frozen_signal,message=ObserverState,signal=TdPosition",
            "no signal 'TdPosition': choose one of",
        ),
        ("frozen_signal,message=DriveStatus,signal=5", "signal is 5, must be the name of a signal"),
        (
            "random_signal,message=DriveStatus,signal=Statusword,low=2,high=1",
            "high is 1.0, must be 2.0 or",
        ),
        ("load_impulse,impulse_n_s=9999,duration_s=0.001", "impulse_n_s is 9999.0, must be within 1000 N"),
        ("reset,node=supervisor", "node is 'supervisor', must be one of controller, plant"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(text, said):
    with pytest.raises(FaultError, match=said) as refused:
        fault_of_text(text)
    assert "\n" not in str(refused.value)


def test_the_names_are_those_of_the_contract():
    """They are kept apart from it so that a scenario file can be judged before a DBC is read."""
    on_the_bus = [message for message in CONTRACT.messages if not message.bench_channel]
    assert sorted(messages()) == sorted(message.name for message in on_the_bus)
    assert sorted(PROTECTED) == sorted(message.name for message in on_the_bus if message.data_ids)
    for message in on_the_bus:
        known = {name for name, signal in message.signals.items() if signal.page is None}
        assert set(signals(message.name)) == known - {"Crc", "Counter"}


def test_the_guide_lists_every_kind_with_its_parameters():
    guide = (Path(__file__).parents[3] / "docs" / "faults.md").read_text(encoding="utf-8")
    begin, end = "<!-- kinds: begin -->\n", "<!-- kinds: end -->"
    shown = guide[guide.index(begin) + len(begin) : guide.index(end)]
    assert shown == kinds_table(), f"write this table:\n{kinds_table()}"


def test_the_command_line_lists_them(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert cli.main(["list", "--faults"]) == 0
    said = capsys.readouterr().out
    first_words = [line.split()[0] for line in said.splitlines()[1:] if not line.startswith("  ")]
    assert first_words == list(KINDS)
    assert "bias_m -1 to 1 m" in said


def test_the_readme_counts_them():
    readme = (Path(__file__).parents[3] / "README.md").read_text(encoding="utf-8")
    assert f"can fail in {len(KINDS)} ways" in readme


def kinds_table() -> str:
    lines = ["| kind | what happens | parameters |", "| --- | --- | --- |"]
    for row in rows():
        kind = f"`{row.kind}`" + ("" if row.real_time else " †")
        lines.append(f"| {kind} | {row.summary} | {'; '.join(row.parameters)} |")
    return "\n".join(lines) + "\n"
