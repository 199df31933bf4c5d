"""Command-line values that more than one program takes."""

import argparse
from fractions import Fraction


def ratio(text: str) -> Fraction:
    """Return a real-time ratio given as a decimal or a fraction.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not above 0 and at most 1.
    """
    try:
        value = Fraction(text)
    except (ValueError, ZeroDivisionError):
        value = Fraction(0)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0 and at most 1")
    return value
