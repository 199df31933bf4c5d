"""python-can without its .mf4 support until that is asked for; imported before python-can by our programs.

python-can imports asammdf wherever that is installed, which costs each process 0.5 s at its start.
"""

import importlib
import sys
from contextlib import suppress
from typing import Any

if "can" not in sys.modules and "asammdf" not in sys.modules:
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # makes its import fail
    importlib.import_module("can")
    del sys.modules["asammdf"]


def load_mf4() -> bool:
    """Have python-can read and write .mf4 from now on; return whether asammdf is there for it."""
    from can.io import mf4
    from can.io.logger import MESSAGE_WRITERS
    from can.io.player import MESSAGE_READERS

    if mf4.asammdf is None:
        mf4 = importlib.reload(mf4)
        MESSAGE_WRITERS[".mf4"], MESSAGE_READERS[".mf4"] = mf4.MF4Writer, mf4.MF4Reader
    if mf4.asammdf is None:
        return False
    mf4.MDF4.__del__ = _close_what_was_opened  # type: ignore[method-assign]
    return True


def _close_what_was_opened(mdf: Any) -> None:
    """Close a file that was refused without the traceback of what its reader had not come to."""
    with suppress(AttributeError):
        mdf.close()
