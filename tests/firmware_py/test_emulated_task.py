"""The whole control task on emulated processors: the same frames and memory, whatever it hears."""

import numpy as np
import pytest
from firmware_events import fuzzed
from firmware_machines import compiled_by_numba, emulated

from firmware_py.chosen_tuning import chosen_tuning
from firmware_py.emulated.processors import TARGETS

CALIBRATION = chosen_tuning().calibration


def assert_same_rows(processor, seed, periods):
    events = list(fuzzed(seed, periods))
    rows = emulated(processor, CALIBRATION, events)
    assert len(rows) == periods
    np.testing.assert_array_equal(rows, compiled_by_numba(CALIBRATION, events))


@pytest.mark.parametrize("processor", TARGETS)
def test_an_eventful_life(processor):
    assert_same_rows(processor, seed=3, periods=4000)


@pytest.mark.long
@pytest.mark.parametrize("processor", TARGETS)
def test_a_hundred_thousand_eventful_periods(processor):
    assert_same_rows(processor, seed=30, periods=100_000)
