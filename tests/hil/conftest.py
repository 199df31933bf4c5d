"""Fixtures of the bench's tests."""

from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest

from hil.bus.hub import Hub, StopFlag
from hil.bus.wire import Wire


@pytest.fixture(autouse=True)
def socket_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep every test's sockets to itself."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def hub() -> Iterator[Hub]:
    """A bus in wall time on channel "test", served by a thread."""
    stopped = StopFlag()
    with Hub(Wire(1_000_000), "test", virtual=False) as hub:
        server = Thread(target=hub.run_in_wall_time, args=(lambda: not stopped.is_set(),))
        server.start()
        try:
            yield hub
        finally:
            stopped.set()
            server.join()
