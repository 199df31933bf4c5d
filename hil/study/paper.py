"""What the paper says beside its tables' figures, and what of our comparison was fitted to it.

The RMS and maximum errors of its Tables 4 and 5 are in the scenarios (``hil/scenarios/*.toml``).
"""

from dataclasses import dataclass

TITLE = "Active Disturbance Rejection Control for Double-Pump Direct-Driven Hydraulics"
PUBLISHED = "S. Zhang, A. Wu, F. Dai, Proceedings 2020, 64, 14"


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One half of Table 4 or 5.

    Attributes
    ----------
    title : str
        What is played.
    table, figure : int
        The paper's numbers.
    fitted : str
        What of our scenario is fitted to the paper; empty if it is the paper's own.
    stated_percent : dict
        By how much ADRC reduces the errors of P and of PI, as the text says: figure and rival.
    """

    title: str
    table: int
    figure: int
    fitted: str
    stated_percent: dict[str, dict[str, int]]


CASES = {
    "sine": PaperCase(
        "sine (28), no load", 4, 5, "", {"max_mm": {"p": 70, "pi": 27}, "rms_mm": {"p": 86, "pi": 66}}
    ),
    "sine_load": PaperCase(
        "sine (28), load step",
        4,
        6,
        "size and time of the load step",
        {"max_mm": {"p": 71, "pi": 27}, "rms_mm": {"p": 89, "pi": 69}},
    ),
    "lift_lower": PaperCase(
        "lifting and lowering, no load",
        5,
        7,
        "the whole reference",
        {"max_mm": {"p": 43, "pi": 58}, "rms_mm": {"p": 78, "pi": 73}},
    ),
    "lift_lower_load": PaperCase(
        "lifting and lowering, load step",
        5,
        8,
        "the whole reference, size and time of the load step",
        {"max_mm": {"p": 48, "pi": 58}, "rms_mm": {"p": 81, "pi": 73}},
    ),
}
"""By scenario."""

FITTED_GAINS = {"p": "Kp fitted to Table 4", "pi": "Kp and Ki fitted to Table 4"}
"""By law of the paper's tuning; ADRC's gains are ours, chosen without regard to the paper's errors."""

WITH_LOAD = {"sine": "sine_load", "lift_lower": "lift_lower_load"}
"""The scenario that adds the load to another one."""
