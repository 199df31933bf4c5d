"""Spectral radius and Ms over stroke and machines, and what they say of the paper's tuning."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from firmware_py.kernel import layout as k
from firmware_py.tuning import TUNINGS, Tuning
from hil.study.box import load_box
from hil.study.linear import OPERATING_POINTS, analyse
from hil.study.stability import POSITIONS_M, describe, heat_map, map_machines, stability_maps
from plant_sim.machine import Machine

PAPER = {"P": (Tuning(), k.LAW_P), "ADRC": (Tuning(), None)}


def test_the_grid_spans_the_stroke_and_the_corners():
    assert POSITIONS_M[[0, -1]] == pytest.approx([0.3e-3, 0.395])
    machines = map_machines()
    assert len(set(machines)) == len(machines) == 3 * (1 + 2**3)
    assert machines[0] == Machine()


@pytest.mark.parametrize("point", OPERATING_POINTS)
def test_a_map_is_the_loops_one_by_one(point):
    machines = [Machine(), Machine(mass=1.5, delay_periods=3), Machine(motor_time_constant_s=0.02)]
    positions = np.array([3e-4, 0.2, 0.395])
    for label, one in stability_maps(PAPER, machines, positions, point).items():
        tuning, law = PAPER[label]
        for row, machine in enumerate(machines):
            for column, x in enumerate(positions):
                loop = analyse(tuning, x, machine=machine, law=law, point=point)
                assert one.loop.spectral_radius[row, column] == pytest.approx(float(loop.spectral_radius))
                assert one.loop.ms[row, column] == pytest.approx(float(loop.ms), rel=1e-6)


def test_machines_that_differ_in_nothing_linear_share_their_loop():
    machines = [Machine(), Machine(position_lsb_um=10), Machine(motor_acceleration_rad_s2=2000.0)]
    one = stability_maps(PAPER, machines, np.array([0.1]))["ADRC"]
    assert np.ptp(one.loop.spectral_radius) == 0.0


@pytest.mark.parametrize(("point", "unstable"), [("shut", 64), ("held", 152)])
def test_the_papers_tuning_is_unstable_at_many_corners_of_the_box(point, unstable):
    corners = load_box().corners()
    assert len(corners) == 256
    summary = stability_maps(PAPER, corners, point=point)["ADRC"].summary()
    assert summary["unstable_machines"] == pytest.approx(unstable, abs=4)


def test_the_summary_names_the_worst_machine_and_position():
    machines = [Machine(), Machine(bulk_modulus=0.3, mass=1.5)]
    summary = stability_maps({"PI*": (TUNINGS["pi_star"], None)}, machines, point="shut")["PI*"].summary()
    assert summary["machines"] == 2
    assert summary["unstable_machines"] == 1
    assert summary["largest_spectral_radius"] > 1.0
    assert summary["largest_spectral_radius_machine"] == "oil ×0.3, mass ×1.5, 1 period"
    assert summary["largest_ms"] is None
    assert summary["first_ms"] == pytest.approx(2.04, abs=0.01)


def test_machines_are_described_in_words():
    assert describe(Machine()) == "nominal, 1 period"
    assert describe(Machine(mass=0.5, efficiency=0.7, delay_periods=2)) == "mass ×0.5, η 0.70, 2 periods"


def test_the_heat_map_has_two_panels_for_each_controller():
    figure = Figure(layout="constrained")
    heat_map(stability_maps(PAPER, map_machines()[:4], np.array([0.1, 0.3, 0.395])))(figure)
    titled = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert titled == [
        f"{label}: {what}" for label in PAPER for what in ("spectral radius", "peak of sensitivity Ms")
    ]
    assert figure.axes[0].get_yticklabels()[0].get_text() == "nominal, 1 period"
