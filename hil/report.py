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
from hil.measure import M_TO_MM, Trace
from hil.run.options import BenchError, Recording

BLUE, ORANGE, GREY, RED = "#0b5394", "#d9730d", "#8a8a8a", "#b02a30"


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


def _mark_faults(axes: Any, faults: list[dict[str, Any]]) -> None:
    """Draw a line where a fault begins, with its kind at the top."""
    for fault in faults:
        for axis in axes:
            axis.axvline(fault["at_s"], color=RED, lw=0.8, ls=":")
        axes[0].annotate(
            fault["kind"],
            (fault["at_s"], 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(-2, -2),
            textcoords="offset points",
            rotation="vertical",
            ha="right",
            va="top",
            fontsize="x-small",
            color=RED,
        )


def draw(path: Path, result: dict[str, Any], trace: Trace) -> None:
    """Draw position, tracking error and observed disturbance over time (the paper's Figure 5)."""
    import matplotlib  # 0.3 s, which only drawing should cost

    matplotlib.use("Agg")
    from matplotlib import pyplot

    time_s = trace["time_s"]
    figure, axes = pyplot.subplots(3, 1, figsize=(9, 8), sharex=True, layout="constrained")
    position, error, disturbance = axes
    paper = result["paper"]
    beside = f"   (paper: {paper['rms_mm']:.3f} / {paper['max_mm']:.3f} mm)" if paper else ""
    bit_rate = f"{result['bit_rate'] / 1e3:g} kbit/s"
    title = f"{result['scenario']}, {result['controller'].upper()}, int32 over CAN at {bit_rate}"
    if result["max_mm"] is not None:
        title += f"\nRMS {result['rms_mm']:.3f} mm, maximum {result['max_mm']:.3f} mm{beside}"
    figure.suptitle(title)

    position.plot(time_s, trace["reference_m"] * M_TO_MM, color=GREY, lw=3, label="reference")
    position.plot(time_s, trace["position_m"] * M_TO_MM, color=BLUE, lw=1.2, label="position")
    position.set_ylabel("position / mm")
    error.plot(time_s, trace["error_m"] * M_TO_MM, color=RED, lw=0.9, label="reference - position")
    error.set_ylabel("error / mm")
    if result["controller"] == "adrc" and "eso_disturbance_m_s3" in trace:
        disturbance.plot(
            time_s, trace["eso_disturbance_m_s3"], color=ORANGE, lw=0.9, label="observed by the ESO, z4"
        )
        disturbance.set_ylabel("total disturbance / (m/s³)")
    elif "target_velocity_rpm" in trace:
        disturbance.plot(
            time_s, trace["target_velocity_rpm"], color=ORANGE, lw=0.9, label="commanded motor speed"
        )
        disturbance.set_ylabel("speed / rpm")
    disturbance.set_xlabel("time / s")
    for axis in axes:
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(loc="best", fontsize="small")
        axis.margins(x=0.01)
    _mark_faults(axes, result["faults"])
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
