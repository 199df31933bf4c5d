"""Parameters: values, sources, bounds, scaling."""

from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_sim import ParameterError, PlantParameters, PumpModel
from plant_sim import layout as at

NUMBERS = [item for item in fields(PlantParameters) if item.name != "pump_model"]
UNIT_SUFFIXES = {
    "m": ("_m",),
    "m³": ("_m3",),
    "mL/rev": ("_ml_per_rev",),
    "Pa": ("_pa",),
    "kg": ("_kg",),
    "kg m²": ("_kg_m2",),
    "rad": ("_rad",),
    "s": ("_s",),
    "s/m": ("_s_per_m",),
    "N/m": ("_n_per_m",),
    "N s/m": ("_n_s_per_m",),
    "m³/(s Pa)": ("_m3_per_s_pa",),
    "rpm": ("_rpm",),
    "rad/s²": ("_rad_s2",),
    "1": ("_efficiency", "_polytropic"),
}


@pytest.mark.parametrize("item", NUMBERS, ids=lambda item: item.name)
def test_every_field_has_source_unit_suffix_and_a_default_within_bounds(item):
    assert item.metadata["source"] == "assumed" or item.metadata["source"].startswith("paper, ")
    assert item.name.endswith(UNIT_SUFFIXES[item.metadata["unit"]])
    low, high = item.metadata["bounds"]
    assert low <= item.default <= high


@pytest.mark.parametrize(
    "wrong", [float("nan"), float("inf"), -float("inf"), 1e300, -1e300, "1", None, True, 1j, [1.0]], ids=repr
)
@pytest.mark.parametrize("item", NUMBERS, ids=lambda item: item.name)
def test_a_wrong_value_is_refused_in_one_line_that_names_field_value_and_range(item, wrong):
    with pytest.raises(ParameterError) as refused:
        PlantParameters(**{item.name: wrong})
    low, high = item.metadata["bounds"]
    message = str(refused.value)
    assert message.startswith(f"{item.name} is {wrong!r}, ")
    assert f"[{low:g}, {high:g}] {item.metadata['unit']}" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"load_mass_kg": -1.0}, "load_mass_kg"),
        ({"dead_volume_a_m3": 0.0}, "dead_volume_a_m3"),
        ({"rod_diameter_m": 0.06}, "rod_diameter_m"),
        ({"retracted_length_m": 0.59}, "retracted_length_m"),
        ({"stroke_m": 0.65}, "retracted_length_m"),
        ({"accumulator_gas_volume_m3": 2e-4}, "accumulator_gas_volume_m3"),
        ({"pump_model": "leaky"}, "pump_model"),
    ],
)
def test_impossible_machines_are_refused(changes, named):
    with pytest.raises(ParameterError, match=f"^{named} is "):
        PlantParameters(**changes)


def test_parameter_errors_are_value_errors():
    assert issubclass(ParameterError, ValueError)


def test_parameters_cannot_be_changed_after_the_check():
    with pytest.raises(FrozenInstanceError):
        PlantParameters().load_mass_kg = -1.0


def test_integers_and_numpy_numbers_are_taken_as_floats():
    parameters = PlantParameters(load_mass_kg=np.float32(41.0), damping_n_s_per_m=400)
    assert type(parameters.load_mass_kg) is float
    assert type(parameters.damping_n_s_per_m) is float


def test_mass_scale_takes_the_cranes_inertia_along_but_not_the_piston():
    heavy = PlantParameters().scaled(mass=1.5)
    assert heavy.load_mass_kg == 60.0
    assert heavy.arm_1_mass_kg == pytest.approx(1.5 * 25.11)
    assert heavy.arm_2_mass_kg == pytest.approx(1.5 * 21.40)
    assert heavy.crane_inertia_kg_m2 == pytest.approx(1.5 * 140.9)
    assert heavy.piston_mass_kg == 5.0


@pytest.mark.parametrize(
    ("scale", "field"),
    [
        ("bulk_modulus", "bulk_modulus_pa"),
        ("efficiency", "volumetric_efficiency"),
        ("leak", "leak_m3_per_s_pa"),
        ("motor_time_constant", "motor_time_constant_s"),
        ("motor_speed", "motor_speed_rpm"),
        ("motor_acceleration", "motor_acceleration_rad_s2"),
        ("precharge", "accumulator_precharge_pa"),
        ("relief_crack", "relief_valve_crack_pa"),
    ],
)
def test_a_scale_multiplies_its_field_and_nothing_else(scale, field):
    nominal = PlantParameters()
    scaled = nominal.scaled(**{scale: 0.5})
    assert getattr(scaled, field) == 0.5 * getattr(nominal, field)
    assert replace(scaled, **{field: getattr(nominal, field)}) == nominal


@pytest.mark.parametrize(("scales", "named"), [({"colour": 2.0}, "colour"), ({"mass": float("nan")}, "mass")])
def test_wrong_scales_are_refused(scales, named):
    with pytest.raises(ParameterError, match=named):
        PlantParameters().scaled(**scales)


def test_scaling_out_of_bounds_names_the_field():
    with pytest.raises(ParameterError, match=r"^volumetric_efficiency is "):
        PlantParameters().scaled(efficiency=1.3)


@given(st.dictionaries(st.sampled_from(["mass", "efficiency", "leak", "relief_crack"]), st.floats(-1e4, 1e4)))
def test_within_bounds_any_factor_is_clipped_to_what_the_parameters_allow(factors):
    scaled, nominal = PlantParameters().scaled_within_bounds(**factors), PlantParameters()
    for item in NUMBERS:
        low, high = item.metadata["bounds"]
        assert low <= getattr(scaled, item.name) <= high
    for group, field in (("efficiency", "volumetric_efficiency"), ("leak", "leak_m3_per_s_pa")):
        low, high = next(item.metadata["bounds"] for item in NUMBERS if item.name == field)
        asked = getattr(nominal, field) * factors.get(group, 1.0)
        assert getattr(scaled, field) == (asked if low <= asked <= high else low if asked < low else high)


def test_within_bounds_nonsense_is_still_refused():
    with pytest.raises(ParameterError, match="leak"):
        PlantParameters().scaled_within_bounds(leak=float("nan"))


def test_vector_is_complete_and_finite():
    vector = PlantParameters().vector()
    assert vector.shape == (at.PARAMETER_COUNT,)
    assert vector.dtype == np.float64
    assert np.isfinite(vector).all()


def test_constant_pumps_deliver_efficiency_times_displacement_without_pressure_losses():
    vector = PlantParameters(pump_model=PumpModel.CONSTANT).vector()
    assert vector[at.PUMP_A_FLOW] == pytest.approx(0.85 * 13.03e-6 / (2 * np.pi))
    assert vector[at.PUMP_A_LOSS] == vector[at.PUMP_B_LOSS] == 0.0


def test_the_pump_model_may_be_given_by_name():
    assert PlantParameters(pump_model="constant").pump_model is PumpModel.CONSTANT
