"""The picture of a run: it says what was played, and shows each fault where it came."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from matplotlib.text import Text

from hil.measure import Trace
from hil.picture import figure_of, heading

NOMINAL = {
    "mass": 1.0,
    "bulk_modulus": 1.0,
    "leak": 1.0,
    "efficiency": 0.85,
    "motor_time_constant_s": 0.005,
    "motor_acceleration_rad_s2": 4000.0,
    "position_lsb_um": 1,
    "delay_periods": 1,
}
RESULT = {
    "scenario": "sine",
    "controller": "adrc",
    "tuning": "paper",
    "firmware": {"name": "python", "execution_us": 100.0},
    "machine": NOMINAL | {"mass": 1.5, "delay_periods": 3},
    "mode": "lockstep",
    "bit_rate": 500_000,
    "rms_mm": 1.25,
    "max_mm": 2.5,
    "paper": None,
    "ending": "",
    "faults": [],
}


@pytest.fixture
def trace() -> Trace:
    """A second of everything that a trace may have."""
    time_s = np.arange(1000) * 1e-3
    names = ("reference_m", "position_m", "error_m", "motor_speed_rpm", "target_velocity_rpm", "load_n")
    return {"time_s": time_s} | {name: np.sin(time_s) for name in (*names, "eso_disturbance_m_s3")}


def at(*times_s: float) -> list[dict]:
    return [{"kind": "sensor_bias", "at_s": at_s, "bias_m": 0.001} for at_s in times_s]


def texts(figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def test_the_heading_names_scenario_law_tuning_machine_and_mode():
    assert heading(RESULT) == "sine, adrc (paper), machine mass=1.5, delay_periods=3, lockstep"
    assert heading(RESULT | {"machine": NOMINAL}) == "sine, adrc (paper), nominal machine, lockstep"


def test_the_heading_names_a_compiled_firmware():
    compiled = RESULT | {"machine": NOMINAL, "firmware": {"name": "cortex-m4", "execution_us": 28.0}}
    assert heading(compiled) == "sine, adrc (paper) on cortex-m4, nominal machine, lockstep"


def test_the_heading_says_which_side_was_started_elsewhere():
    elsewhere = RESULT | {"machine": None, "tuning": None, "firmware": None, "mode": "realtime"}
    assert heading(elsewhere) == "sine, adrc (started elsewhere), plant started elsewhere, realtime"


def test_the_picture_says_what_was_played_and_what_is_wrong_with_it(trace):
    verdict = "the controller was in standby at 2.000 s: the errors are not those of tracking"
    title = figure_of(RESULT | {"verdict": verdict}, trace).get_suptitle()
    assert heading(RESULT) in title
    assert "0.5 Mbit/s" in title
    assert "RMS 1.250 mm, maximum 2.500 mm" in title
    assert verdict in title


def test_every_axis_has_a_unit(trace):
    axes = figure_of(RESULT, trace).axes
    assert [one.get_ylabel().split(" / ")[0] for one in axes] == [
        "position",
        "error",
        "motor speed",
        "load force",
        "total disturbance",
    ]
    assert all(" / " in one.get_ylabel() for one in axes)
    assert axes[-1].get_xlabel() == "time / s"


@pytest.mark.parametrize("law", ["p", "pi", "pi_ff", "scheduled"])
def test_only_adrc_has_an_observer_to_show_and_only_a_load_is_shown(trace, law):
    trace["load_n"] *= 0.0
    axes = figure_of(RESULT | {"controller": law}, trace).axes
    assert [one.get_ylabel() for one in axes] == ["position / mm", "error / mm", "motor speed / rpm"]


def test_what_only_the_bus_shows_of_a_run_is_drawn(trace):
    shown = ("time_s", "reference_m", "position_m", "error_m", "target_velocity_rpm")
    assert len(figure_of(RESULT, {name: trace[name] for name in shown}).axes) == 3


def test_each_fault_has_a_line_and_its_text_as_a_command_takes_it(trace):
    figure = figure_of(RESULT | {"faults": at(0.7, 0.2)}, trace)
    assert "1: sensor_bias,at_s=0.2,bias_m=0.001\n2: sensor_bias,at_s=0.7,bias_m=0.001" in texts(figure)
    for axes in figure.axes:
        assert [line.get_xdata()[0] for line in axes.lines[-2:]] == [0.2, 0.7]


@pytest.mark.parametrize(
    "times_s",
    [(0.5,) * 3, (0.0, 0.001, 0.02, 0.05, 0.051, 0.5, 0.99), tuple(np.linspace(0.0, 0.999, 99))],
    ids=["at once", "crowded", "everywhere"],
)
def test_numbers_of_faults_overlap_neither_one_another_nor_anything_else(trace, times_s):
    figure = figure_of(RESULT | {"faults": at(*times_s)}, trace)
    figure.draw_without_rendering()
    numbers = [(text.get_text(), text.get_window_extent()) for text in figure.axes[0].texts]
    spans = [[int(end) for end in label.split("-")] for label, _ in numbers]
    assert (spans[0][0], spans[-1][-1]) == (1, len(times_s)), "none is left out"
    assert all(after[0] == before[-1] + 1 for before, after in pairwise(spans))
    assert not any(one.overlaps(other) for (_, one), (_, other) in combinations(numbers, 2))
    others = [*figure.texts, figure._suptitle, figure.axes[-1].xaxis.label]
    boxes = [box for _, box in numbers] + [text.get_window_extent() for text in {*others}]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_of_many_faults_the_first_are_listed_and_the_others_counted(trace):
    listed = texts(figure_of(RESULT | {"faults": at(*np.linspace(0.0, 0.9, 30))}, trace))
    assert any(text.endswith("and 18 more, in result.json") for text in listed)
