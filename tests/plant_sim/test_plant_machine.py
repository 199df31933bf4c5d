"""A machine that differs from the nominal one: what its keys mean, and what is refused."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_sim.equilibrium import initial_state
from plant_sim.machine import Machine
from plant_sim.parameters import ParameterError, PlantParameters

NOMINAL = PlantParameters()


def values_of(item):
    low, high = item.metadata["bounds"]
    return st.integers(low, high) if item.type is int else st.floats(low, high)


MACHINES = st.builds(Machine, **{item.name: values_of(item) for item in fields(Machine)})


def test_the_default_machine_is_the_nominal_one():
    assert Machine().parameters == NOMINAL
    assert Machine().sensor().read(0.123_456_4) == 123_456
    assert Machine().delay_periods == 1


def test_factors_scale_and_values_replace():
    parameters = Machine(mass=1.5, bulk_modulus=0.5, leak=2.0, efficiency=0.7).parameters
    assert parameters == NOMINAL.scaled(mass=1.5, bulk_modulus=0.5, leak=2.0, efficiency=0.7 / 0.85)
    parameters = Machine(motor_time_constant_s=0.02, motor_acceleration_rad_s2=2000.0).parameters
    assert parameters.motor_time_constant_s == 0.02
    assert parameters.motor_acceleration_rad_s2 == 2000.0
    assert Machine(position_lsb_um=10).sensor().read(0.123_456) == 123_460


@given(MACHINES)
def test_every_machine_within_the_bounds_can_be_built_and_rests_somewhere(machine):
    for position_m in (0.0, 0.2):
        assert np.isfinite(initial_state(machine.parameters, position_m)).all()


@given(MACHINES)
def test_the_text_of_a_machine_makes_it_again(machine):
    assert Machine().with_text(machine.text) == machine


def test_a_text_changes_only_what_it_names():
    machine = Machine(mass=1.2, leak=2.0).with_text("mass=1.5, position_lsb_um=10")
    assert machine == Machine(mass=1.5, leak=2.0, position_lsb_um=10)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("mas=1", "machine: there is no 'mas', only mass, bulk_modulus, leak, efficiency"),
        ("mass=0", "machine: mass is 0.0, must be a number from 0.1 to 10 times nominal"),
        ("mass=heavy", "machine: mass is 'heavy', must be a number from 0.1 to 10 times nominal"),
        ("mass=nan", "machine: mass is nan, must be a number"),
        ("efficiency=1.01", "machine: efficiency is 1.01, must be a number from 0.1 to 1"),
        ("delay_periods=4", "machine: delay_periods is 4.0, must be a whole number from 1 to 3 periods"),
        ("position_lsb_um=2.5", "machine: position_lsb_um is 2.5, must be a whole number from 1 to 10000 µm"),
        ("mass", "machine: 'mass' is not of the form KEY=VALUE"),
        ("", "machine: '' is not of the form KEY=VALUE"),
        ("mass=1,mass=2", "machine: 'mass=1,mass=2' is not of the form KEY=VALUE,KEY=VALUE, each key once"),
    ],
)
def test_what_is_refused(text, what):
    with pytest.raises(ParameterError) as refused:
        Machine().with_text(text)
    assert str(refused.value).startswith(what)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("value", [True, "1", None, [1.0]])
def test_values_of_another_type_are_refused(value):
    with pytest.raises(ParameterError, match="machine: mass is"):
        Machine(mass=value)
