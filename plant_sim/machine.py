"""A machine as built: what may differ from the nominal one, sensor and drive included."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Real
from typing import Any, Self

from plant_sim.drive import MAX_DELAY_PERIODS
from plant_sim.parameters import NOMINAL, ParameterError, PlantParameters
from plant_sim.sensors import PositionSensor


def _factor(called: str, low: float, high: float) -> Any:
    return field(default=1.0, metadata={"called": called, "unit": "times nominal", "bounds": (low, high)})


def _value(called: str, default: float, unit: str, low: float, high: float) -> Any:
    return field(default=default, metadata={"called": called, "unit": unit, "bounds": (low, high)})


@dataclass(frozen=True, slots=True)
class Machine:
    """What varies from one machine to the next; the defaults are the nominal one.

    Each field's metadata holds what it is ``called``, its ``unit`` and closed ``bounds``.

    Parameters
    ----------
    mass, bulk_modulus, leak : float
        Factors on the moving masses and their inertia, on the oil's stiffness, and on both pumps' leaks.
    efficiency : float
        Volumetric efficiency of the pumps, η.
    motor_time_constant_s, motor_acceleration_rad_s2 : float
        Lag and largest acceleration of the motor.
    position_lsb_um : int
        Resolution of the position sensor.
    delay_periods : int
        Drive cycles from the controller's sample to the drive taking the command; see `plant_sim.drive`.

    Raises
    ------
    ParameterError
        One line that names the key, its value and what is allowed.
    """

    mass: float = _factor("moving mass", 0.1, 10.0)
    bulk_modulus: float = _factor("oil's bulk modulus", 0.05, 10.0)
    leak: float = _factor("pumps' leak", 0.0, 100.0)
    efficiency: float = _value("pumps' efficiency", NOMINAL.volumetric_efficiency, "", 0.1, 1.0)
    motor_time_constant_s: float = _value(
        "motor's time constant", NOMINAL.motor_time_constant_s, "s", 1e-4, 1.0
    )
    motor_acceleration_rad_s2: float = _value(
        "motor's largest acceleration", NOMINAL.motor_acceleration_rad_s2, "rad/s²", 1.0, 1e6
    )
    position_lsb_um: int = _value("sensor's resolution", 1, "µm", 1, 10_000)
    delay_periods: int = _value("drive's delay", 1, "periods", 1, MAX_DELAY_PERIODS)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = self._checked(item, getattr(self, item.name))
            object.__setattr__(self, item.name, value)

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "Machine":
        """Return the nominal machine with the keys of a table changed."""
        return cls().with_changes(table)

    def with_changes(self, table: Mapping[str, Any]) -> Self:
        """Return a copy with the keys of a table changed.

        Raises
        ------
        ParameterError
            If there is no such key, or its value is not allowed.
        """
        names = [item.name for item in fields(self)]
        for key in table:
            if key not in names:
                raise ParameterError(f"machine: there is no {key!r}, only {', '.join(names)}")
        return replace(self, **table)

    def with_text(self, text: str) -> Self:
        """Return a copy with what a text like ``mass=1.5,position_lsb_um=10`` says changed.

        Raises
        ------
        ParameterError
            If the text is of another form, or as for `with_changes`.
        """
        table: dict[str, Any] = {}
        for part in text.split(","):
            key, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or key in table:
                raise ParameterError(
                    f"machine: {text!r} is not of the form KEY=VALUE,KEY=VALUE, each key once"
                )
            table[key] = _number(value)
        return self.with_changes(table)

    @property
    def text(self) -> str:
        """All keys in the form that `with_text` reads back without loss."""
        return ",".join(f"{key}={value!r}" for key, value in asdict(self).items())

    @property
    def changes(self) -> str:
        """What differs from the nominal machine, for people to read; empty if nothing does."""
        nominal = asdict(type(self)())
        return ", ".join(f"{key}={value:g}" for key, value in asdict(self).items() if value != nominal[key])

    @property
    def parameters(self) -> PlantParameters:
        """Parameters of the plant."""
        return replace(
            NOMINAL.scaled(mass=self.mass, bulk_modulus=self.bulk_modulus, leak=self.leak),
            volumetric_efficiency=self.efficiency,
            motor_time_constant_s=self.motor_time_constant_s,
            motor_acceleration_rad_s2=self.motor_acceleration_rad_s2,
        )

    def sensor(self, noise_rms_m: float = 0.0, seed: int = 0) -> PositionSensor:
        """Return the position sensor."""
        return PositionSensor(self.position_lsb_um * 1e-6, noise_rms_m, seed)

    @staticmethod
    def _checked(item: Any, value: Any) -> float | int:
        (low, high), unit = item.metadata["bounds"], item.metadata["unit"]
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        whole = item.type is int
        if not (is_number and low <= value <= high and (not whole or value == int(value))):
            kind = "a whole number" if whole else "a number"
            allowed = f"{kind} from {low:g} to {high:g} {unit}".rstrip()
            raise ParameterError(f"machine: {item.name} is {value!r}, must be {allowed}")
        return int(value) if whole else float(value)


def _number(text: str) -> float | str:
    """Return the number a text says; the text itself, for the complaint, if it says none."""
    try:
        return float(text)
    except ValueError:
        return text
