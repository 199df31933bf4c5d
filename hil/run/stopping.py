"""How a long-running command is asked to end."""

import os
import signal


class StopFlag:
    """Set by a signal handler, read by loops."""

    def __init__(self) -> None:
        self._set = False

    @classmethod
    def on_signals(cls) -> "StopFlag":
        """Return a flag that Ctrl-C, a termination request and a closed terminal set."""
        flag = cls()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, flag.set)
        return flag

    def set(self, *_: object) -> None:
        """Ask loops to end; usable as a signal handler."""
        self._set = True

    def is_set(self) -> bool:
        """Tell whether loops are to end."""
        return self._set


def orphaned(parent: int | None) -> bool:
    """Tell whether the process that started this one, if it said its id, has ended."""
    return parent is not None and os.getppid() != parent
