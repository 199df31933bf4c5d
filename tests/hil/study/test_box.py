"""Boxes of machines: what they contain, and what is no box."""

from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from hil.study.box import Box, BoxError, load_box
from plant_sim.machine import Machine

SMALL = Box({"mass": (0.5, 1.5), "delay_periods": (1, 3)})


def test_the_built_in_box_has_eight_keys_and_256_corners():
    corners = load_box().corners()
    assert len(set(corners)) == 256
    assert {corner.delay_periods for corner in corners} == {1, 3}
    assert {corner.bulk_modulus for corner in corners} == {0.3, 1.5}


def test_corners_are_all_combinations_of_the_ends():
    expected = {Machine(mass=mass, delay_periods=delay) for mass, delay in product((0.5, 1.5), (1, 3))}
    assert set(SMALL.corners()) == expected


def test_a_range_of_one_value_makes_no_corner():
    assert len(Box({"mass": (0.5, 1.5), "leak": (2.0, 2.0)}).corners()) == 2


def test_what_the_box_does_not_name_stays_the_bases():
    base = Machine(efficiency=0.9)
    for machine in (*SMALL.corners(base), *SMALL.samples(10, base=base)):
        assert replace(machine, mass=1.0, delay_periods=1) == base


def test_samples_fill_each_range_evenly():
    """A Latin hypercube: one sample in each of as many equal parts of a range as there are samples."""
    machines = load_box().samples(200, seed=3)
    for key, (low, high) in load_box().ranges.items():
        values = np.array([getattr(machine, key) for machine in machines])
        assert values.min() >= low
        assert values.max() <= high
        if isinstance(low, int):
            counts = np.bincount(values.astype(int))[low:]
            assert np.ptp(counts) <= 1
        else:
            parts = np.floor((values - low) / (high - low) * 200).astype(int)
            assert sorted(parts) == list(range(200))


def test_equal_seeds_give_equal_samples():
    assert SMALL.samples(20, seed=1) == SMALL.samples(20, seed=1)
    assert SMALL.samples(20, seed=1) != SMALL.samples(20, seed=2)


def test_whole_numbers_stay_whole():
    assert all(type(machine.delay_periods) is int for machine in SMALL.samples(20))


def test_a_file_is_a_box(tmp_path: Path):
    file = tmp_path / "box.toml"
    file.write_text("mass = [0.8, 1.2]\nposition_lsb_um = [1, 5]\n")
    assert dict(load_box(file).ranges) == {"mass": (0.8, 1.2), "position_lsb_um": (1, 5)}


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "box: it is empty; give KEY = [LOWEST, HIGHEST] for some of mass, bulk_modulus"),
        ("mass = [1.5, 0.5]", r"box: mass is [1.5, 0.5], which is inverted"),
        ("mas = [1.0, 2.0]", "box: there is no 'mas', only mass, bulk_modulus"),
        ("mass = 1.0", "box: mass is 1.0, must be [LOWEST, HIGHEST]"),
        ("mass = [1.0]", "box: mass is [1.0], must be [LOWEST, HIGHEST]"),
        ("mass = [1.0, 99.0]", "box: mass is 99.0, must be a number from 0.1 to 10 times nominal"),
        ("mass = ['a', 1.0]", "box: mass is 'a', must be a number"),
        ("mass = [nan, 1.0]", "box: mass is nan, must be a number"),
        ("delay_periods = [1, 2.5]", "box: delay_periods is 2.5, must be a whole number from 1 to 3 periods"),
        ("mass = [", "Invalid value"),
    ],
)
def test_what_is_no_box(tmp_path: Path, text: str, what: str):
    file = tmp_path / "box.toml"
    file.write_text(text)
    with pytest.raises(BoxError) as refused:
        load_box(file)
    assert what in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_box_that_cannot_be_read(tmp_path: Path):
    with pytest.raises(BoxError, match=r"cannot read .*none.toml \(No such file"):
        load_box(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(BoxError, match="bytes"):
        load_box(tmp_path / "bytes.toml")


def test_every_key_of_the_built_in_box_has_the_nominal_value_inside():
    nominal = asdict(Machine())
    assert all(low <= nominal[key] <= high for key, (low, high) in load_box().ranges.items())
