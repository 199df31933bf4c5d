"""Fixtures of the bench's tests."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench_runs import serving

from hil.bus.hub import Hub


@pytest.fixture(autouse=True)
def socket_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep every test's sockets to itself."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture(autouse=True)
def signal_handlers() -> Iterator[None]:
    """Put back what the command line sets."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def hub() -> Iterator[Hub]:
    """A bus in wall time on channel "test"."""
    with serving("test") as hub:
        yield hub
