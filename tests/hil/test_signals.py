"""Signals of a bus log by name, against cantools."""

from collections import defaultdict
from functools import cache
from pathlib import Path

import cantools
import numpy as np
import pytest
from bench_runs import short_scenario

import dbc
from dbc.contract import Contract
from dbc.frame import EFF_FLAG
from hil.run.inprocess import run_inprocess
from hil.run.options import Recording, RunOptions
from hil.signals import NothingKnownError, Series, signal_of

CONTRACT = Contract.load()
DATABASE = cantools.database.load_file(Path(dbc.__file__).parent / "ddh.dbc")
NAMES = [
    f"{message.name}.{signal.name}"
    for message in DATABASE.messages
    for signal in message.signals
    if message.name != "BenchControl" or signal.name in ("Command", "InitialPosition")
]


@cache
def recording() -> Recording:
    scenario = short_scenario(0.5, load=((0.1, -1500.0),))
    return run_inprocess(RunOptions(scenario, "adrc", record_directory=Path()))


@cache
def decoded() -> dict[str, tuple[list[float], list[float]]]:
    """Every signal of every frame as cantools decodes it: times, s, and values."""
    series: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for end_ns, can_id, dlc, data in recording().traffic.tolist():
        message = DATABASE.get_message_by_frame_id(can_id & (EFF_FLAG - 1))
        signals = message.decode(data.to_bytes(8, "little")[:dlc], decode_choices=False)
        for name, value in signals.items():
            times, values = series[f"{message.name}.{name}"]
            times.append((end_ns - recording().start_ns) / 1e9)
            values.append(value)
    return series


@pytest.mark.parametrize("name", NAMES)
def test_every_signal_is_what_cantools_decodes(name):
    times, values = decoded()[name]
    series = signal_of(recording().traffic, CONTRACT, name, recording().start_ns)
    assert len(series) == len(times) > 0
    assert np.array_equal(series.time_s, times)
    assert series.values == pytest.approx(values, rel=1e-12, abs=0)


def test_each_page_of_the_observer_has_frames_of_its_own():
    pages = [name for name in NAMES if name.startswith("ObserverState.") and "Page" not in name]
    per_page = [len(signal_of(recording().traffic, CONTRACT, name)) for name in pages if "Cycle" not in name]
    assert len(per_page) == 7
    assert sum(per_page) == len(signal_of(recording().traffic, CONTRACT, "ObserverState.Page"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Nothing.Position", r"no message 'Nothing': choose one of DriveCommand, PositionFeedback"),
        ("DriveCommand.Speed", r"DriveCommand has no signal 'Speed': choose one of .*TargetVelocity"),
        ("DriveCommand", r"DriveCommand has no signal ''"),
    ],
)
def test_a_wrong_name_is_told_what_there_is(name, said):
    with pytest.raises(ValueError, match=said):
        signal_of(recording().traffic, CONTRACT, name)


def test_a_series_leaves_out_what_is_unknown():
    series = Series(np.array([0.0, 0.1, 0.2, 0.3]), np.array([3.0, -4.0, np.nan, np.nan]))
    assert (series.max, series.last) == (4.0, -4.0)
    assert series.rms == pytest.approx(12.5**0.5)
    assert series.first(-4.0) == 0.1
    assert series.between(0.1, 0.2).values.tolist() == [-4.0]


@pytest.mark.parametrize("figure", ["max", "rms", "last"])
@pytest.mark.parametrize("values", [[], [np.nan]])
def test_a_series_without_values_has_no_figures(figure, values):
    nothing = Series(np.zeros(len(values)), np.array(values))
    with pytest.raises(NothingKnownError, match=f"none of {len(values)} values is known"):
        getattr(nothing, figure)
    assert "none known" in repr(nothing)
    assert np.isnan(nothing.first(0.0))
