"""What a run leaves on disk: figures, trace, bus log and picture."""

import json
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from can.io.logger import MESSAGE_WRITERS

from hil.bus_log import check_log_format, write_bus_log
from hil.measure import Trace
from hil.picture import draw
from hil.run.options import BenchError, Recording


class ResultFolder:
    """A folder whose files are made beside it and moved in at the end, so that none is ever half-written.

    Parameters
    ----------
    path : Path
        The folder; made if it is missing.

    Attributes
    ----------
    path : Path
        The folder.
    scratch : Path
        Where the files are made.

    Raises
    ------
    BenchError
        If the folder cannot be written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made = [folder for folder in (path, *path.parents) if not os.path.lexists(folder)]
        try:
            path.mkdir(parents=True, exist_ok=True)
            self.scratch = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=path))
        except OSError as error:
            raise BenchError(f"cannot write to {path} ({error.strerror}): choose another --out") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._clean_up()

    def move_in(self, made: list[Path]) -> list[Path]:
        """Move files from the scratch folder in and return their paths."""
        return [file.replace(self.path / file.name) for file in made]

    def _clean_up(self) -> None:
        """Remove what is not a result, folders made for nothing included."""
        shutil.rmtree(self.scratch, ignore_errors=True)
        with suppress(OSError):  # the first folder that holds something ends it
            for folder in self._made:
                folder.rmdir()


class OutputDirectory(ResultFolder):
    """A run's folder.

    Parameters
    ----------
    path : Path
        The folder; made if it is missing.
    log_format : str
        Suffix of the bus log that one of python-can's writers knows.

    Attributes
    ----------
    left_out : int
        Frames that were left out of the bus log because its format has no room for them.

    Raises
    ------
    BenchError
        If the folder cannot be written to, or no writer knows the suffix.
    """

    def __init__(self, path: Path, log_format: str) -> None:
        check_log_format(log_format)
        super().__init__(path)
        self.left_out = 0
        self._log_format = log_format

    def write(self, result: dict[str, Any], trace: Trace, recording: Recording) -> list[Path]:
        """Write all files and return their paths."""
        made = [self.scratch / "result.json"]
        made[0].write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        made.append(self.scratch / f"bus{self._log_format}")
        self.left_out = write_bus_log(made[-1], recording.traffic, recording.payloads)
        if len(trace["time_s"]):
            made.append(self.scratch / "trace.csv")
            header = ",".join(trace)
            np.savetxt(
                made[-1], np.column_stack(list(trace.values())), "%.10g", ",", header=header, comments=""
            )
        if "error_m" in trace and len(trace["time_s"]) > 1:
            made.append(self.scratch / "picture.png")
            draw(made[-1], result, trace)
        for old in (self.path / name for name in ("result.json", "trace.csv", "picture.png")):
            old.unlink(missing_ok=True)
        for old in self.path.glob("bus.*"):
            if old.suffix in MESSAGE_WRITERS:
                old.unlink()
        return self.move_in(made)
