"""The bench in pytest: fixtures, options, what a failing test leaves, and figures for JUnit XML.

A test that takes the fixture `bench` gets a machine that is brought up and enabled::

    @pytest.mark.bench(tuning="paper")
    def test_load_is_rejected(bench):
        bench.setpoint(sine)
        bench.run(3.0)
        bench.load_force(-2000)
        bench.run(2.0)
        assert bench.error_mm.max < 1.45

``@pytest.mark.bench(controller="pi", position_m=0.2, bit_rate=500_000)`` says how it begins,
``@pytest.mark.bench(machine={"mass": 1.5}, tuning="pi_star")`` on what machine and under which tuning, and
``@pytest.mark.needs("wire_faults")`` what only some interfaces have: where they have not, the test is not
applicable, and counted as such.
"""

import argparse
import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from firmware_py.chosen_firmware import ChosenFirmware
    from firmware_py.chosen_tuning import ChosenTuning
    from hil.bench import Bench
    from hil.run.rig import Rig
    from plant_sim.machine import Machine

MODES = ("inprocess", "lockstep", "realtime")
BEGINNINGS: dict[str, tuple[tuple[type, ...], str]] = {
    "controller": ((str,), "the name of a control law"),
    "position_m": ((int, float), "a number"),
    "bit_rate": ((int, type(None)), "a whole number"),
    "machine": ((Mapping,), "a table"),
    "tuning": ((str, Path), "a name, or a Path to a file"),
}
"""What the marker `bench` takes: types, and the same in words."""
OURS = ("dbc", "firmware_py", "hil", "plant_sim")
STARTS = {"both": ("plant", "controller"), "none": (), "plant": ("plant",), "controller": ("controller",)}

_VIRTUAL = frozenset({"virtual_time", "wire_faults", "power"})
CAPABILITIES = {  # what a test may need, by interface
    "inprocess": _VIRTUAL,
    "lockstep": _VIRTUAL,
    "hilbus": frozenset({"wall_time"}),
    "socketcan": frozenset({"wall_time", "real_bus"}),
}
_OTHER_ADAPTER = frozenset({"wall_time", "real_bus"})
OF_SIDES = {"plant": "machine", "controller": "tuning"}
"""What a test may choose, and so need, of a side that is started here."""

_not_applicable = pytest.StashKey[Counter[str]]()
_applicable = pytest.StashKey[int]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the bench's options."""
    group = parser.getgroup("hil", "bench of a controller on a CAN bus")
    group.addoption("--hil-mode", choices=MODES, default="lockstep", help="default lockstep")
    group.addoption(
        "--hil-interface",
        metavar="I",
        help="realtime: python-can interface, with plant and firmware on it (default: own bus and processes)",
    )
    group.addoption("--hil-channel", metavar="C", help="its channel; lockstep: for listeners")
    group.addoption(
        "--hil-start",
        choices=STARTS,
        help="realtime: which side to start here (default none with --hil-interface, else both)",
    )
    group.addoption("--hil-start-timeout", type=float, default=120.0, metavar="S", help="default 120 s")
    group.addoption("--rt-ratio", default="1", metavar="R", help="realtime: 0.1 is ten times slower")
    group.addoption(
        "--hil-firmware",
        default="python",
        metavar="NAME,K=V",
        help="as hil run: cortex-m4, rv32imc,clock_mhz=100 ...",
    )
    group.addoption("--hil-bitrate", type=int, metavar="B", help="bit/s (default 1000000)")
    group.addoption(
        "--hil-out", type=Path, default=Path("out/pytest"), metavar="DIR", help="default out/pytest"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register markers, and refuse options that do not go together."""
    config.addinivalue_line(
        "markers",
        "bench(controller=..., position_m=0.0, bit_rate=None, machine={}, tuning=...): how the bench begins",
    )
    config.addinivalue_line("markers", "needs(*what): not applicable where the interface lacks it")
    if config.getoption("hil_interface") and config.getoption("hil_mode") != "realtime":
        raise pytest.UsageError("--hil-interface needs --hil-mode realtime")
    if _ratio(config) != 1 and config.getoption("hil_mode") != "realtime":
        raise pytest.UsageError("--rt-ratio needs --hil-mode realtime: virtual time has no pace")
    if config.getoption("hil_firmware") != "python":
        _firmware(config)  # refused before a test begins, in one line


def interface_of(config: pytest.Config) -> str:
    """Return the interface that tests run on: "inprocess", "lockstep", or python-can's name in real time."""
    mode: str = config.getoption("hil_mode")
    return config.getoption("hil_interface") or "hilbus" if mode == "realtime" else mode


@pytest.hookimpl(trylast=True)  # what -k and -m leave
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what needs what the interface lacks."""
    has = CAPABILITIES.get(interface_of(config), _OTHER_ADAPTER)
    has |= {OF_SIDES[side] for side in _started(config)}
    known = sorted({*OF_SIDES.values(), *(need for needs in CAPABILITIES.values() for need in needs)})
    lacking: Counter[str] = Counter()
    out = []
    for item in filter(_has_bench, items):
        needs = [need for marker in item.iter_markers("needs") for need in marker.args]
        if begins := item.get_closest_marker("bench"):
            needs += [need for need in OF_SIDES.values() if need in begins.kwargs]
        if unknown := [need for need in needs if need not in known]:
            raise pytest.UsageError(
                f"{item.nodeid}: nothing has {unknown[0]!r}: choose from {', '.join(known)}"
            )
        if missing := [need for need in needs if need not in has]:
            lacking[missing[0]] += 1
            out.append(item)
    config.stash[_not_applicable] = lacking
    config.hook.pytest_deselected(items=out)
    items[:] = [item for item in items if item not in out]
    config.stash[_applicable] = sum(map(_has_bench, items))


def _started(config: pytest.Config) -> tuple[str, ...]:
    """Return the sides that are started here."""
    return STARTS[config.getoption("hil_start") or ("none" if config.getoption("hil_interface") else "both")]


def _has_bench(item: pytest.Item) -> bool:
    return "_benches" in getattr(item, "fixturenames", ())


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say what was not applicable, and why."""
    lacking, applicable = config.stash.get(_not_applicable, Counter()), config.stash.get(_applicable, 0)
    if not lacking and not applicable:
        return
    passed = sum("bench" in dict(report.user_properties) for report in terminalreporter.getreports("passed"))
    why = ", ".join(f"{count} need {what}" for what, count in sorted(lacking.items())) or "none"
    scenarios = "scenario" if applicable == 1 else "scenarios"
    terminalreporter.write_line(
        f"hil: {applicable} {scenarios} on {interface_of(config)}, {passed} passed; "
        f"{sum(lacking.values())} not applicable ({why})"
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note the figures of the benches a test had; of a failing one leave the folder and say how to replay."""
    benches: list[Bench] = getattr(item, "funcargs", {}).get("_benches", [])
    if call.excinfo and _has_bench(item) and not item.config.getoption("fulltrace"):
        _end_traceback_at_test(call.excinfo)
    if call.when != "call" or not benches:
        return (yield)
    trouble = ""
    try:
        for bench in benches:
            item.user_properties.append(("bench", bench.mode))
            item.user_properties.extend(_properties(bench.result(item.name)))
    except Exception as error:  # a test's own verdict counts, not what its figures suffer from
        trouble = f"no figures ({error})\n"
    report = yield
    if report.failed:
        try:
            folders = [str(_leave(item, bench, number)) for number, bench in enumerate(benches)]
            trouble += f"results in {', '.join(folders)}"
        except Exception as error:
            trouble += f"no results could be left ({error})"
        report.sections.append(("bench", f"{trouble}\nreplay: {_replay_command(item)}"))
    return report


def _end_traceback_at_test(excinfo: pytest.ExceptionInfo[BaseException]) -> None:
    """Leave of the traceback of what the bench refuses what comes before the bench: the line of the test."""
    from hil.run.options import BenchError

    if not isinstance(excinfo.value, AssertionError | BenchError | ValueError):
        return
    entry: TracebackType | None = excinfo.tb
    last = excinfo.tb
    while entry:
        if entry.tb_frame.f_globals.get("__name__", "").partition(".")[0] not in OURS:
            last = entry
        entry = entry.tb_next
    if last.tb_next:
        last.tb_next = None
        excinfo.value.__cause__ = None


@pytest.fixture(scope="session")
def hil_rig(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> "Iterator[Callable[..., Rig]]":
    """Return what gives the rig of this test session; a broken one, or another machine's, is replaced."""
    import can

    from firmware_py.chosen_tuning import chosen_tuning
    from hil.bus.link import LinkError
    from hil.run.options import BenchError
    from hil.run.rig import RigKeeper
    from plant_sim.machine import Machine

    def rig(machine: Mapping[str, Any] | None = None, tuning: str | Path | None = None) -> "Rig":
        chosen = chosen_tuning(file=tuning) if isinstance(tuning, Path) else chosen_tuning(tuning)
        try:
            return keeper.rig(Machine.from_table(machine or {}), chosen)
        except (BenchError, LinkError, can.CanInitializationError) as error:
            pytest.exit(f"hil: {error}", returncode=2)

    def new_rig(machine: Machine, tuning: "ChosenTuning") -> "Rig":
        return _new_rig(request.config, tmp_path_factory.mktemp("rig"), machine, tuning)

    with RigKeeper(new_rig) as keeper:
        yield rig


@pytest.fixture
def _benches() -> "list[Bench]":
    """Return the benches of this test."""
    return []


@pytest.fixture
def bench_at(hil_rig: "Callable[..., Rig]", _benches: "list[Bench]") -> "Iterator[Callable[..., Bench]]":
    """Return what makes a bench, with the arguments of the marker ``bench``."""
    from hil.bench import Bench

    def bench_at(
        machine: Mapping[str, Any] | None = None,
        tuning: str | Path | None = None,
        controller: str = "",
        position_m: float = 0.0,
        bit_rate: int | None = None,
    ) -> "Bench":
        for earlier in _benches:
            earlier.end()
        bench = Bench(hil_rig(machine, tuning), controller, position_m, bit_rate)
        _benches.append(bench)
        return bench

    yield bench_at
    for bench in _benches:
        bench.end()


@pytest.fixture
def bench(request: pytest.FixtureRequest, bench_at: "Callable[..., Bench]") -> "Bench":
    """Return a bench that is brought up and enabled; the marker `bench` says how it begins."""
    from hil.run.options import BenchError

    marker = request.node.get_closest_marker("bench")
    if refused := _wrong_beginning(marker) if marker else "":
        pytest.fail(refused, pytrace=False)
    try:
        return bench_at(**(marker.kwargs if marker else {}))
    except (BenchError, ValueError) as error:
        refused = str(error)
    pytest.fail(refused, pytrace=False)


def _wrong_beginning(marker: pytest.Mark) -> str:
    """Return what is wrong with a marker `bench`; empty if it can be had."""
    if marker.args:
        return f"a bench takes no {marker.args[0]!r}: say of what, e.g. controller={marker.args[0]!r}"
    for key, value in marker.kwargs.items():
        if key not in BEGINNINGS:
            return f"a bench takes no {key!r}: choose from {', '.join(BEGINNINGS)}"
        types, words = BEGINNINGS[key]
        if not isinstance(value, types):
            return f"{key} of a bench is {value!r}, must be {words}"
    return ""


def _new_rig(config: pytest.Config, directory: Path, machine: "Machine", tuning: "ChosenTuning") -> "Rig":
    from hil.bus.opening import bus_settings
    from hil.run.options import RigOptions
    from hil.run.rigs import RIGS

    interface, channel = config.getoption("hil_interface"), config.getoption("hil_channel")
    bit_rate = config.getoption("hil_bitrate")
    if interface:
        interface, channel, bit_rate = bus_settings(interface, channel, bit_rate)
    options = RigOptions(
        record_directory=directory,
        bit_rate=bit_rate,
        interface=interface,
        channel=channel,
        rt_ratio=_ratio(config),
        started=frozenset(_started(config)),
        machine=machine,
        tuning=tuning,
        firmware=_firmware(config),
        start_timeout_s=config.getoption("hil_start_timeout"),
    )
    return RIGS[config.getoption("hil_mode")](options)


def _firmware(config: pytest.Config) -> "ChosenFirmware":
    from firmware_py.chosen_firmware import FirmwareError, firmware_of_text

    try:
        return firmware_of_text(config.getoption("hil_firmware"))
    except FirmwareError as error:
        raise pytest.UsageError(f"--hil-firmware: {error}") from error


def _ratio(config: pytest.Config) -> Fraction:
    from hil.run.arguments import ratio

    try:
        return ratio(config.getoption("rt_ratio"))
    except argparse.ArgumentTypeError as error:
        raise pytest.UsageError(f"--rt-ratio: {error}") from error


def _properties(result: dict[str, Any]) -> list[tuple[str, object]]:
    """Return a run's figures as JUnit properties."""
    timing = result["timing"]
    figures = {key: result[key] for key in ("rms_mm", "max_mm", "bus_load_percent", "bus_sha256")}
    for name, figure in timing.items():
        figures |= (
            {f"{name}_{key}": value for key, value in figure.items()}
            if isinstance(figure, dict)
            else {name: figure}
        )
    return list(figures.items())


def _leave(item: pytest.Item, bench: "Bench", number: int) -> Path:
    """Write a bench's folder and return it."""
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in f"{item.path.stem}.{item.name}")
    folder: Path = item.config.getoption("hil_out") / (f"{name}-{number + 1}" if number else name)
    bench.write(folder, item.name)
    return folder


def _replay_command(item: pytest.Item) -> str:
    """Return the command line that runs one test again as it ran."""
    given = [argument for argument in item.config.invocation_params.args if str(argument).startswith("-")]
    options = []
    for option in (
        "hil-mode",
        "hil-interface",
        "hil-channel",
        "hil-start",
        "hil-firmware",
        "rt-ratio",
        "hil-bitrate",
    ):
        value = item.config.getoption(option.replace("-", "_"))
        if value is not None and any(str(argument).startswith(f"--{option}") for argument in given):
            options.append(f"--{option}={value}")
    path = os.path.relpath(item.path, item.config.invocation_params.dir)
    test = "::".join([path, *item.nodeid.split("::")[1:]])
    return shlex.join([sys.executable, "-m", "pytest", test, *options])
