"""Fixtures of the controller's tests."""

from types import ModuleType

import pytest
from hypothesis import settings

from firmware_py import checked

settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")  # the first call of a jitted function compiles it


@pytest.fixture(scope="session")
def kernel_modules() -> dict[str, ModuleType]:
    """The kernel's modules on checked integers."""
    return checked.load()
