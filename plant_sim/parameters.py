"""The machine's parameters: values, units, sources and bounds, checked at construction."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from numbers import Real
from typing import Any

import numpy as np

from plant_sim import layout as at

GRAVITY_M_S2 = 9.81
MAX_LOAD_N = 1e6
"""Largest load on the rod that may be asked for."""
OVERTRAVEL_M = 0.02
"""The crane's triangle must close this far beyond either end stop."""


class ParameterError(ValueError):
    """A plant parameter is outside its bounds, of the wrong type, or contradicts another one."""


class PumpModel(StrEnum):
    """How volumetric efficiency acts."""

    HIGH_TO_LOW = "high_to_low"
    """The loss (1 - η)|ω|D runs from the high to the low pressure side."""
    CONSTANT = "constant"
    """Flow is η ω D whatever the pressures (eqs 1, 2)."""


def _paper(default: float, where: str, unit: str, low: float, high: float) -> Any:
    return field(default=default, metadata={"source": f"paper, {where}", "unit": unit, "bounds": (low, high)})


def _assumed(default: float, unit: str, low: float, high: float) -> Any:
    return field(default=default, metadata={"source": "assumed", "unit": unit, "bounds": (low, high)})


_SCALED_FIELDS = {
    "mass": ("arm_1_mass_kg", "arm_2_mass_kg", "load_mass_kg", "crane_inertia_kg_m2"),
    "bulk_modulus": ("bulk_modulus_pa",),
    "efficiency": ("volumetric_efficiency",),
    "leak": ("leak_m3_per_s_pa",),
    "precharge": ("accumulator_precharge_pa",),
    "relief_crack": ("relief_valve_crack_pa",),
    "motor_time_constant": ("motor_time_constant_s",),
    "motor_speed": ("motor_speed_rpm",),
    "motor_acceleration": ("motor_acceleration_rad_s2",),
}


@dataclass(frozen=True, slots=True)
class PlantParameters:
    """Parameters of the double-pump direct-driven cylinder and its micro-crane.

    Each field's metadata holds ``source`` ("paper, Table 2" or "assumed"), ``unit`` and closed ``bounds``.

    Raises
    ------
    ParameterError
        One line that names the field, its value and what is allowed.
    """

    pump_a_displacement_ml_per_rev: float = _paper(13.03, "Table 2", "mL/rev", 0.1, 1000.0)
    pump_b_displacement_ml_per_rev: float = _paper(9.35, "Table 2", "mL/rev", 0.1, 1000.0)
    volumetric_efficiency: float = _paper(0.85, "section 2.2.1", "1", 0.1, 1.0)
    piston_diameter_m: float = _paper(0.060, "Table 2", "m", 0.005, 1.0)
    rod_diameter_m: float = _paper(0.030, "Table 2", "m", 0.001, 1.0)
    bulk_modulus_pa: float = _paper(7e8, "Table 2", "Pa", 1e7, 1e10)
    stroke_m: float = _paper(0.400, "Table 2", "m", 0.01, 5.0)
    damping_n_s_per_m: float = _paper(500.0, "Table 2", "N s/m", 0.0, 1e6)
    dead_volume_a_m3: float = _paper(2e-6, "Table 2", "m³", 1e-7, 1e-2)
    dead_volume_b_m3: float = _paper(2e-6, "Table 2", "m³", 1e-7, 1e-2)

    boom_length_d1_m: float = _paper(0.983, "Table 3", "m", 0.05, 10.0)
    arm_1_mass_kg: float = _paper(25.11, "Table 3", "kg", 0.01, 1e4)
    arm_2_mass_kg: float = _paper(21.40, "Table 3", "kg", 0.01, 1e4)
    load_mass_kg: float = _paper(40.0, "Table 3", "kg", 0.01, 1e4)
    arm_2_radius_m: float = _paper(0.977, "Table 3", "m", 0.0, 10.0)
    load_radius_m: float = _paper(1.674, "Table 3", "m", 0.0, 10.0)
    arm_1_angle_rad: float = _paper(0.1169, "Table 3", "rad", -math.pi, math.pi)
    arm_2_angle_rad: float = _paper(0.1572, "Table 3", "rad", -math.pi, math.pi)
    load_angle_rad: float = _paper(0.1775, "Table 3", "rad", -math.pi, math.pi)

    mast_length_d2_m: float = _assumed(0.40, "m", 0.05, 10.0)
    retracted_length_m: float = _assumed(0.72, "m", 0.05, 10.0)
    arm_1_radius_m: float = _assumed(0.50, "m", 0.0, 10.0)
    crane_inertia_kg_m2: float = _assumed(140.9, "kg m²", 0.01, 1e6)
    piston_mass_kg: float = _assumed(5.0, "kg", 0.0, 1e3)
    stop_stiffness_n_per_m: float = _assumed(1e8, "N/m", 1e6, 1e10)
    stop_damping_s_per_m: float = _assumed(20.0, "s/m", 0.0, 1e3)

    pump_loss_pressure_pa: float = _assumed(1e5, "Pa", 1e3, 1e7)
    leak_m3_per_s_pa: float = _assumed(2e-11, "m³/(s Pa)", 0.0, 1e-8)
    accumulator_gas_volume_m3: float = _assumed(1.3e-3, "m³", 1e-4, 1.0)
    accumulator_precharge_pa: float = _assumed(3.5e5, "Pa", 1e5, 5e6)
    accumulator_polytropic: float = _assumed(1.3, "1", 1.0, 1.7)
    check_valve_gain_m3_per_s_pa: float = _assumed(5e-9, "m³/(s Pa)", 1e-10, 1e-6)
    check_valve_crack_pa: float = _assumed(0.2e5, "Pa", 0.0, 5e5)
    relief_valve_gain_m3_per_s_pa: float = _assumed(3.3e-10, "m³/(s Pa)", 1e-11, 1e-6)
    relief_valve_crack_pa: float = _assumed(160e5, "Pa", 0.0, 1e8)
    vapour_pressure_pa: float = _assumed(1e3, "Pa", 0.0, 1e4)
    atmosphere_pa: float = _assumed(101325.0, "Pa", 5e4, 1.2e5)

    motor_time_constant_s: float = _assumed(5e-3, "s", 1e-4, 1.0)
    motor_speed_rpm: float = _assumed(3000.0, "rpm", 1.0, 20000.0)
    motor_acceleration_rad_s2: float = _assumed(4000.0, "rad/s²", 1.0, 1e6)

    pump_model: PumpModel = field(
        default=PumpModel.HIGH_TO_LOW, metadata={"source": "assumed", "unit": "", "bounds": tuple(PumpModel)}
    )

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.name != "pump_model":
                self._check_number(item.name, item.metadata["unit"], *item.metadata["bounds"])
        try:
            object.__setattr__(self, "pump_model", PumpModel(self.pump_model))
        except ValueError:
            allowed = ", ".join(PumpModel)
            raise ParameterError(f"pump_model is {self.pump_model!r}, must be one of {allowed}") from None
        self._check_consistency()

    def _check_number(self, name: str, unit: str, low: float, high: float) -> None:
        value = getattr(self, name)
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if not (is_number and low <= value <= high):
            raise ParameterError(f"{name} is {value!r}, must be a number in [{low:g}, {high:g}] {unit}")
        object.__setattr__(self, name, float(value))

    def _check_consistency(self) -> None:
        if self.rod_diameter_m >= self.piston_diameter_m:
            raise ParameterError(
                f"rod_diameter_m is {self.rod_diameter_m}, "
                f"must be below piston_diameter_m {self.piston_diameter_m}"
            )
        shortest = abs(self.boom_length_d1_m - self.mast_length_d2_m) + OVERTRAVEL_M
        longest = self.boom_length_d1_m + self.mast_length_d2_m - OVERTRAVEL_M - self.stroke_m
        if not shortest <= self.retracted_length_m <= longest:
            raise ParameterError(
                f"retracted_length_m is {self.retracted_length_m}, must be in [{shortest:g}, {longest:g}] m "
                "for the crane's triangle to close over the stroke"
            )
        swept = self.rod_area_m2 * self.stroke_m
        if self.accumulator_gas_volume_m3 < swept:
            raise ParameterError(
                f"accumulator_gas_volume_m3 is {self.accumulator_gas_volume_m3}, "
                f"must be at least the rod's volume {swept:g} m³"
            )

    @property
    def piston_area_m2(self) -> float:
        """A_A."""
        return math.pi / 4.0 * self.piston_diameter_m**2

    @property
    def rod_area_m2(self) -> float:
        """A_A - A_B."""
        return math.pi / 4.0 * self.rod_diameter_m**2

    @property
    def annulus_area_m2(self) -> float:
        """A_B."""
        return self.piston_area_m2 - self.rod_area_m2

    @property
    def pump_a_displacement_m3_per_rad(self) -> float:
        """D_A."""
        return self.pump_a_displacement_ml_per_rev * 1e-6 / (2.0 * math.pi)

    @property
    def pump_b_displacement_m3_per_rad(self) -> float:
        """D_B."""
        return self.pump_b_displacement_ml_per_rev * 1e-6 / (2.0 * math.pi)

    @property
    def motor_speed_rad_s(self) -> float:
        """Top speed of the motor."""
        return self.motor_speed_rpm * math.pi / 30.0

    def scaled(self, **factors: float) -> "PlantParameters":
        """Return a copy with groups of parameters multiplied.

        Parameters
        ----------
        **factors : float
            Any of ``mass`` (m1, m2, m_load and with them J), ``bulk_modulus``, ``efficiency``, ``leak``,
            ``precharge``, ``relief_crack``, ``motor_time_constant``, ``motor_speed``, ``motor_acceleration``.

        Examples
        --------
        >>> PlantParameters().scaled(mass=1.5, leak=2.0).load_mass_kg
        60.0
        """
        return replace(self, **self._products(factors))

    def scaled_within_bounds(self, **factors: float) -> "PlantParameters":
        """Return a copy with groups of parameters multiplied, each parameter clipped to its bounds.

        As for `scaled`, for factors that come from outside: whatever they are, the machine can be computed.

        Examples
        --------
        >>> PlantParameters().scaled_within_bounds(efficiency=2.0).volumetric_efficiency
        1.0
        """
        changes = self._products(factors)
        for item in fields(self):
            if item.name in changes:
                low, high = item.metadata["bounds"]
                changes[item.name] = min(max(changes[item.name], low), high)
        return replace(self, **changes)

    def _products(self, factors: Mapping[str, float]) -> dict[str, Any]:
        products: dict[str, Any] = {}
        for group, factor in factors.items():
            if group not in _SCALED_FIELDS:
                raise ParameterError(f"no scale named {group!r}, must be one of {', '.join(_SCALED_FIELDS)}")
            if isinstance(factor, bool) or not isinstance(factor, Real) or not math.isfinite(factor):
                raise ParameterError(f"scale {group} is {factor!r}, must be a finite number")
            products.update({name: getattr(self, name) * factor for name in _SCALED_FIELDS[group]})
        return products

    def vector(self) -> np.ndarray:
        """Return the flat float64 array that the compiled plant reads, indexed by `plant_sim.layout`."""
        constant = self.pump_model is PumpModel.CONSTANT
        kept = self.volumetric_efficiency if constant else 1.0
        lost = 0.0 if constant else 1.0 - self.volumetric_efficiency
        gamma_0 = self._retracted_gamma_rad()
        moments = (  # m r in kg m, angle from the vertical at γ = 0 in rad
            (self.arm_1_mass_kg * self.arm_1_radius_m, self.arm_1_angle_rad - gamma_0),
            (self.arm_2_mass_kg * self.arm_2_radius_m, self.arm_2_angle_rad - gamma_0),
            (self.load_mass_kg * self.load_radius_m, self.load_angle_rad - gamma_0),
        )
        p = np.empty(at.PARAMETER_COUNT)
        p[at.PISTON_AREA] = self.piston_area_m2
        p[at.ANNULUS_AREA] = self.annulus_area_m2
        p[at.STROKE] = self.stroke_m
        p[at.DEAD_VOLUME_A] = self.dead_volume_a_m3
        p[at.DEAD_VOLUME_B] = self.dead_volume_b_m3
        p[at.BULK_MODULUS] = self.bulk_modulus_pa
        p[at.VISCOUS_DAMPING] = self.damping_n_s_per_m
        p[at.ATMOSPHERE_FORCE] = self.atmosphere_pa * self.rod_area_m2
        p[at.STOP_STIFFNESS] = self.stop_stiffness_n_per_m
        p[at.STOP_DAMPING] = self.stop_damping_s_per_m
        p[at.PUMP_A_FLOW] = kept * self.pump_a_displacement_m3_per_rad
        p[at.PUMP_B_FLOW] = kept * self.pump_b_displacement_m3_per_rad
        p[at.PUMP_A_LOSS] = lost * self.pump_a_displacement_m3_per_rad
        p[at.PUMP_B_LOSS] = lost * self.pump_b_displacement_m3_per_rad
        p[at.PUMP_LOSS_PRESSURE] = self.pump_loss_pressure_pa
        p[at.LEAK] = self.leak_m3_per_s_pa
        p[at.CHECK_GAIN] = self.check_valve_gain_m3_per_s_pa
        p[at.CHECK_CRACK] = self.check_valve_crack_pa
        p[at.RELIEF_GAIN] = self.relief_valve_gain_m3_per_s_pa
        p[at.RELIEF_CRACK] = self.relief_valve_crack_pa
        p[at.VAPOUR_PRESSURE] = self.vapour_pressure_pa
        p[at.GAS_VOLUME] = self.accumulator_gas_volume_m3
        p[at.PRECHARGE] = self.accumulator_precharge_pa
        p[at.POLYTROPIC] = self.accumulator_polytropic
        p[at.RETRACTED_LENGTH] = self.retracted_length_m
        p[at.LENGTH_SQUARES] = self.boom_length_d1_m**2 + self.mast_length_d2_m**2
        p[at.LENGTH_PRODUCT] = self.boom_length_d1_m * self.mast_length_d2_m
        p[at.INERTIA] = self.crane_inertia_kg_m2
        p[at.PISTON_MASS] = self.piston_mass_kg
        p[at.GRAVITY_SIN] = GRAVITY_M_S2 * sum(moment * math.cos(angle) for moment, angle in moments)
        p[at.GRAVITY_COS] = GRAVITY_M_S2 * sum(moment * math.sin(angle) for moment, angle in moments)
        p[at.MOTOR_TIME_CONSTANT] = self.motor_time_constant_s
        p[at.MOTOR_MAX_SPEED] = self.motor_speed_rad_s
        p[at.MOTOR_MAX_ACCELERATION] = self.motor_acceleration_rad_s2
        return p

    def _retracted_gamma_rad(self) -> float:
        """γ0 by the cosine rule (16) at x = 0."""
        d1, d2 = self.boom_length_d1_m, self.mast_length_d2_m
        return math.acos((d1**2 + d2**2 - self.retracted_length_m**2) / (2.0 * d1 * d2))


NOMINAL = PlantParameters()
