"""The paper's state-space model (8), as printed, half mended and consistent, against the plant.

x⃛ = k1 ẋ + k2 ẍ + k3 ω + f knows no leak, no valves and no pump loss that depends on pressure; f, the change
of the load, is zero here. The paper validates it in Figure 3b against its mathematical model, of which it is
the short form. That one is compared with measurements in Figure 3a, whose data are unpublished: there is
nothing to compare with. So is the motor's speed in both; `SPEED_PROFILE` is ours.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plant_sim.crane import rod_dynamics
from plant_sim.derived import StateSpaceCoefficients, coefficients_of_stiffness
from plant_sim.hydraulics import chamber_volumes
from plant_sim.open_loop import simulate
from plant_sim.parameters import NOMINAL, PlantParameters, PumpModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PERIOD_S = 1e-3
ROUNDING_M = 1e-6
SPEED_PROFILE = (  # s, rad/s, straight lines between
    (0.0, 0.0),
    (0.3, 0.0),
    (0.8, 100.0),
    (4.3, 100.0),
    (4.8, 0.0),
    (5.8, 0.0),
    (5.82, -75.0),
    (8.8, -75.0),
    (9.3, 0.0),
    (10.0, 0.0),
)
PLANTS = {
    "paper's assumptions": replace(NOMINAL, pump_model=PumpModel.CONSTANT, leak_m3_per_s_pa=0.0),
    "full plant": NOMINAL,
}
"""The first has eqs (1) to (7) with the crane: constant η, no leak. It traps oil, see the plant's tests."""
MODE_AT_M = 0.15
GAIN_AT_M = 0.20


@dataclass(frozen=True, slots=True)
class Form:
    """How the rod side enters k1 and k3, and what moves.

    Attributes
    ----------
    rod_side_sign : float
        +1 adds the rod side's terms, -1 subtracts them as printed.
    chamber_b_shrinks : bool
        As the rod extends; (6) prints that it grows.
    mass_kg : float or None
        None is the crane's effective mass at the position; Table 2 prints 50 kg.
    """

    rod_side_sign: float
    chamber_b_shrinks: bool
    mass_kg: float | None = None


FORMS = {
    "consistent": Form(1.0, True),
    "consistent, 50 kg": Form(1.0, True, 50.0),
    "literal": Form(-1.0, False),
    "literal, 50 kg": Form(-1.0, False, 50.0),
    "half mended": Form(-1.0, True),
    "half mended, 50 kg": Form(-1.0, True, 50.0),
}
"""Literal is (8) as printed; in the half mended form only (6) is mended."""


def coefficients_of_form(
    parameters: PlantParameters, form: Form
) -> Callable[[float], StateSpaceCoefficients]:
    """Return the function that gives k1, k2, k3 of a form at a position in m."""
    p = parameters.vector()
    stiffness_a = parameters.bulk_modulus_pa * parameters.piston_area_m2**2
    stiffness_b = form.rod_side_sign * parameters.bulk_modulus_pa * parameters.annulus_area_m2**2

    def coefficients(position_m: float) -> StateSpaceCoefficients:
        volume_a, volume_b = chamber_volumes(position_m, p)
        if not form.chamber_b_shrinks:
            _, volume_b = chamber_volumes(parameters.stroke_m - position_m, p)
        mass = rod_dynamics(position_m, p)[0] if form.mass_kg is None else form.mass_kg
        return coefficients_of_stiffness(parameters, mass, stiffness_a / volume_a, stiffness_b / volume_b)

    return coefficients


def simulate_form(
    motor_speed_rad_s: np.ndarray,
    form: Form,
    parameters: PlantParameters = NOMINAL,
    initial_position_m: float = 0.0,
) -> np.ndarray:
    """Integrate (8) from rest, exactly for coefficients and motor speed frozen over each millisecond.

    Parameters
    ----------
    motor_speed_rad_s : ndarray, shape (n,)
        At the start of each millisecond.
    form : Form
    parameters : PlantParameters
    initial_position_m : float

    Returns
    -------
    position_m : ndarray, shape (n,)
        At the start of each millisecond; NaN from where the model leaves the stroke.
    """
    coefficients = coefficients_of_form(parameters, form)
    speeds = 0.5 * (motor_speed_rad_s + np.append(motor_speed_rad_s[1:], motor_speed_rad_s[-1]))
    positions = np.full(speeds.size, np.nan)
    x, v, a = initial_position_m, 0.0, 0.0
    for step, speed in enumerate(speeds.tolist()):
        if not -ROUNDING_M <= x <= parameters.stroke_m:
            break
        positions[step] = x
        k = coefficients(x + 0.5 * PERIOD_S * v)
        steady = -k.k3_m_per_rad_s2 * speed / k.k1_per_s2
        damping = 0.5 * k.k2_per_s
        root = cmath.sqrt(damping * damping + k.k1_per_s2)
        poles = (damping + root, damping - root)
        shares = (
            (a - poles[1] * (v - steady)) / (2.0 * root),
            (poles[0] * (v - steady) - a) / (2.0 * root),
        )
        ends = [share * cmath.exp(pole * PERIOD_S) for share, pole in zip(shares, poles, strict=True)]
        moved = sum((end - share) / pole for end, share, pole in zip(ends, shares, poles, strict=True))
        x += steady * PERIOD_S + moved.real
        v = steady + sum(ends).real
        a = sum(end * pole for end, pole in zip(ends, poles, strict=True)).real
    return positions


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Figure 3b: forms of (8) beside the plant, all under the same motor speed.

    Attributes
    ----------
    time_s, motor_speed_rad_s : ndarray
    plants, forms : dict of ndarray
        Positions in m by the names of `PLANTS` and `FORMS`; NaN from where a form leaves the stroke.
    """

    time_s: np.ndarray
    motor_speed_rad_s: np.ndarray
    plants: dict[str, np.ndarray]
    forms: dict[str, np.ndarray]

    def figures(self) -> dict[str, dict[str, Any]]:
        """Return the errors as plain numbers.

        Returns
        -------
        figures : dict of dict
            By form: ``errors_mm`` with ``rms`` and ``max`` by plant, over the time within the stroke;
            ``left_stroke_s`` or None; ``speed_gain_m_per_rad``, -k3/k1 at 0.2 m; ``mode_hz`` at 0.15 m, None
            where the form is unstable.
        """
        table = {}
        for name, positions in self.forms.items():
            coefficients = coefficients_of_form(NOMINAL, FORMS[name])
            middle, at_mode = coefficients(GAIN_AT_M), coefficients(MODE_AT_M)
            inside = np.isfinite(positions)
            errors = {plant: (positions - truth)[inside] * 1e3 for plant, truth in self.plants.items()}
            table[name] = {
                "errors_mm": {
                    plant: {"rms": float(np.sqrt(np.mean(e**2))), "max": float(np.abs(e).max())}
                    for plant, e in errors.items()
                },
                "left_stroke_s": None if inside.all() else float(self.time_s[~inside][0]),
                "speed_gain_m_per_rad": float(-middle.k3_m_per_rad_s2 / middle.k1_per_s2),
                "mode_hz": math.sqrt(-at_mode.k1_per_s2) / (2 * math.pi) if at_mode.k1_per_s2 < 0 else None,
            }
        return table


def validate() -> Validation:
    """Run the plants and all forms through the speed profile; takes seconds."""
    end_s = SPEED_PROFILE[-1][0]
    time_s = np.arange(round(end_s / PERIOD_S)) * PERIOD_S
    corners_s, speeds = np.transpose(SPEED_PROFILE)
    command = np.interp(time_s, corners_s, speeds)
    traces = {name: simulate(command, parameters=plant) for name, plant in PLANTS.items()}
    speed = traces["full plant"].motor_speed_rad_s
    return Validation(
        time_s,
        speed,
        {name: trace.position_m for name, trace in traces.items()},
        {name: simulate_form(speed, form) for name, form in FORMS.items()},
    )


_STYLES = {  # Okabe and Ito's colours; dashes for 50 kg
    "consistent": "#0072b2",
    "literal": "#e69f00",
    "half mended": "#d55e00",
}
_RINGING_S = (5.75, 6.15)


def figure_3b(validation: Validation) -> Callable[["Figure"], None]:
    """Return what draws positions, errors under the paper's assumptions, and speeds as the motor reverses."""

    def draw(figure: "Figure") -> None:
        figure.set_size_inches(8.5, 7.0)
        position, error, speed = figure.subplots(3, 1)
        time_s = validation.time_s
        for (name, values), line in zip(validation.plants.items(), ("-", ":"), strict=True):
            position.plot(time_s, values * 1e3, color="#000000", ls=line, lw=2.5, alpha=0.4, label=name)
        for name, values in validation.forms.items():
            _line(position, name, time_s, values * 1e3)
            _line(error, name, time_s, (values - validation.plants["paper's assumptions"]) * 1e3)
        shown = (time_s >= _RINGING_S[0]) & (time_s <= _RINGING_S[1])
        truth = np.gradient(validation.plants["paper's assumptions"], PERIOD_S)
        speed.plot(time_s[shown], truth[shown] * 1e3, color="#000000", lw=2.5, alpha=0.4)
        for name in ("consistent", "consistent, 50 kg"):
            values = np.gradient(validation.forms[name], PERIOD_S)
            _line(speed, name, time_s[shown], values[shown] * 1e3)
        position.set_ylabel("position / mm")
        position.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        error.set_ylabel("error / mm")
        error.set_ylim(-20.0, 50.0)
        speed.set_ylabel("rod's speed / (mm/s)")
        speed.set_xlabel("time / s")
        speed.legend()

    return draw


def _line(axes: "Axes", name: str, time_s: np.ndarray, values: np.ndarray) -> None:
    form, _, mass = name.partition(",")
    axes.plot(time_s, values, color=_STYLES[form], ls="--" if mass else "-", label=name)
