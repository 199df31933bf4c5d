"""Signals of a bus log by their names in the DBC."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from dbc.codec import MessageCodec
from dbc.contract import Contract

_MULTIPLEXOR_BITS = 8


class NothingKnownError(ValueError):
    """A figure was asked of a quantity of which no value is known."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Series:
    """A quantity over time; its figures raise `NothingKnownError` where there is nothing to take them from.

    Attributes
    ----------
    time_s : ndarray of float
        Times, s.
    values : ndarray of float
        Values at those times; NaN where unknown.
    """

    time_s: np.ndarray
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        known = f"last {self.last:.6g}, largest magnitude {self.max:.6g}" if self.known.size else "none known"
        return f"<{len(self)} values, {known}>"

    @property
    def known(self) -> np.ndarray:
        """The values that are known."""
        return self.values[np.isfinite(self.values)]

    @property
    def rms(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self._some() ** 2)))

    @property
    def max(self) -> float:
        """Largest magnitude."""
        return float(np.abs(self._some()).max())

    @property
    def last(self) -> float:
        """Newest known value."""
        return float(self._some()[-1])

    def between(self, begin_s: float, end_s: float = float("inf")) -> "Series":
        """Return the part from `begin_s` until before `end_s`."""
        inside = (self.time_s >= begin_s - 1e-9) & (self.time_s < end_s - 1e-9)
        return Series(self.time_s[inside], self.values[inside])

    def first(self, value: float) -> float:
        """Return the time at which the quantity is `value` for the first time, s; NaN if it never is."""
        when = self.time_s[self.values == value]
        return float(when[0]) if when.size else float("nan")

    def _some(self) -> np.ndarray:
        known = self.known
        if not known.size:
            raise NothingKnownError(f"none of {len(self)} values is known: let the bench run on first")
        return known


def decoded(message: MessageCodec[..., Any], data: int) -> dict[str, str]:
    """Return the signals of a payload by their DBC names: values with units, or the DBC's words for them."""
    shown = {}
    for name, signal in message.signals.items():
        if signal.page is None or data & (1 << _MULTIPLEXOR_BITS) - 1 == signal.page:
            raw = data >> signal.start & (1 << signal.length) - 1
            if signal.signed and raw >> signal.length - 1:
                raw -= 1 << signal.length
            value = f"{raw * signal.factor + signal.offset:.10g} {signal.unit}".strip()
            shown[name] = signal.choices.get(raw, value)
    return shown


def signal_of(traffic: np.ndarray, contract: Contract, name: str, start_ns: int = 0) -> Series:
    """Return a signal in physical units, at the ends of the frames that carried it.

    Parameters
    ----------
    traffic : ndarray of uint64, shape (frames, 4)
        As in `hil.run.options.Recording`.
    contract : Contract
        The DBC.
    name : str
        ``Message.Signal``, as in the DBC.
    start_ns : int
        Bus time from which the times count.

    Raises
    ------
    ValueError
        If there is no such message or signal.
    """
    message_name, _, signal_name = name.partition(".")
    message = contract.message(message_name)
    signal = message.signals.get(signal_name)
    if signal is None:
        raise ValueError(
            f"{message_name} has no signal {signal_name!r}: choose one of {', '.join(message.signals)}"
        )
    rows = traffic[traffic[:, 1] == message.can_id]
    if signal.page is not None:
        rows = rows[rows[:, 3] & np.uint64((1 << _MULTIPLEXOR_BITS) - 1) == signal.page]
    raw = (rows[:, 3] >> np.uint64(signal.start) & np.uint64((1 << signal.length) - 1)).astype(np.int64)
    if signal.signed:
        sign = 1 << signal.length - 1
        raw = (raw ^ sign) - sign
    time_s = (rows[:, 0].astype(np.int64) - start_ns) / 1e9
    return Series(time_s, raw * signal.factor + signal.offset)
