"""Bus logs: the same frames whatever format they were written in and whatever they were converted to."""

import gzip
import subprocess
import sys
from collections import Counter
from pathlib import Path
from unittest.mock import patch

import can
import can.logconvert
import numpy as np
import pytest
from bench_runs import SAFETY_NET_S, hil
from cantools.logreader import Parser
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from dbc.frame import EFF_FLAG, ERR_FLAG
from hil.bus_log import read_bus_log, write_bus_log
from hil.run.options import BenchError

FORMATS = (".log", ".asc", ".blf", ".mf4")
KEEP_ERRORS = (".blf", ".mf4")
"""Formats that keep the class and the data of error frames; the others keep that and when there was one."""

UNIX_TIME_US = 1_795_000_000_000_000


@st.composite
def frames(draw) -> tuple[int, int, int]:
    """Draw id, dlc and data of a data frame with an id of either length."""
    can_id = draw(st.one_of(st.integers(0, 0x7FF), st.integers(EFF_FLAG, EFF_FLAG | 0x1FFF_FFFF)))
    payload = draw(st.binary(max_size=8))
    return can_id, len(payload), int.from_bytes(payload, "little")


@st.composite
def error_frames(draw) -> tuple[int, int, int]:
    """Draw an error frame as Linux shows it: class bits and eight bytes."""
    return ERR_FLAG | draw(st.integers(1, 0x1FF)), 8, draw(st.integers(0, 2**64 - 1))


@st.composite
def traffics(draw) -> np.ndarray:
    """Draw a log with at least one data frame, at whole µs that rise."""
    drawn = [draw(frames()), *draw(st.lists(st.one_of(frames(), frames(), error_frames()), max_size=12))]
    gaps_us = draw(st.lists(st.integers(1, 2_000_000), min_size=len(drawn), max_size=len(drawn)))
    begin_us = draw(st.sampled_from([0, 599, 31_000_123, UNIX_TIME_US]))
    times_ns = (begin_us + np.cumsum([0, *gaps_us[1:]])) * 1000
    return np.array([(t, *frame) for t, frame in zip(times_ns.tolist(), drawn, strict=True)], np.uint64)


def kept(traffic: np.ndarray, *formats: str) -> np.ndarray:
    """Return what is left of a log: times from the first frame on, errors as far as the formats keep them."""
    left = traffic.copy()
    left[:, 0] -= left[0, 0]
    if not set(formats) <= set(KEEP_ERRORS):
        left[left[:, 1] & ERR_FLAG != 0, 1:] = ERR_FLAG, 0, 0
    return left


def convert(source: Path, target: Path) -> None:
    """Run python-can's own converter."""
    with patch.object(sys, "argv", ["can_logconvert", str(source), str(target)]):
        can.logconvert.main()


@pytest.mark.parametrize("second", FORMATS)
@pytest.mark.parametrize("first", FORMATS)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(traffic=traffics())
def test_a_log_written_in_one_format_and_read_in_another_has_the_same_frames(
    tmp_path, first, second, traffic
):
    source, target = tmp_path / f"first{first}", tmp_path / f"second{second}"
    write_bus_log(source, traffic)
    assert np.array_equal(kept(read_bus_log(source).traffic, first), kept(traffic, first))
    convert(source, target)
    assert np.array_equal(kept(read_bus_log(target).traffic, first, second), kept(traffic, first, second))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(traffic=traffics())
def test_cantools_reads_the_frames_of_a_candump_log(tmp_path, traffic):
    path = tmp_path / "bus.log"
    write_bus_log(path, traffic)
    data_frames = traffic[traffic[:, 1] & ERR_FLAG == 0]
    with open(path) as file:
        lines = [frame for frame in Parser(file) if not frame.frame_id & ERR_FLAG]
    assert [
        (frame.frame_id | (EFF_FLAG if frame.is_extended_frame else 0), frame.data) for frame in lines
    ] == [(i, data.to_bytes(8, "little")[:dlc]) for i, dlc, data in data_frames[:, 1:].tolist()]
    stamps_us = [round(frame.timestamp.timestamp() * 1e6) for frame in lines]
    assert stamps_us == (data_frames[:, 0] // 1000).tolist()


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mf4"])
def test_times_are_those_of_the_bus(tmp_path, suffix):
    write_bus_log(tmp_path / f"bus{suffix}", np.array([(599_000, 0x100, 0, 0)], np.uint64))
    assert read_bus_log(tmp_path / f"bus{suffix}").traffic[0, 0] == 599_000


@pytest.mark.parametrize("suffix", FORMATS)
def test_frames_of_the_same_instant_keep_their_order(tmp_path, suffix):
    traffic = np.array([(0, can_id, 1, can_id) for can_id in (5, 3, 4, 1, 2)], np.uint64)
    write_bus_log(tmp_path / f"bus{suffix}", traffic)
    assert np.array_equal(read_bus_log(tmp_path / f"bus{suffix}").traffic, traffic)


def test_a_compressed_log_is_read(tmp_path):
    traffic = np.array([(0, 0x100, 2, 0xBEEF)], np.uint64)
    write_bus_log(tmp_path / "bus.log.gz", traffic)
    assert np.array_equal(read_bus_log(tmp_path / "bus.log.gz").traffic, traffic)


def log_of(path: Path, *messages: can.Message) -> Path:
    with can.Logger(path) as writer:
        for message in messages:
            writer.on_message_received(message)
    return path


def test_frames_that_no_node_takes_are_left_out_and_counted(tmp_path):
    path = log_of(
        tmp_path / "bus.asc",
        can.Message(timestamp=0.0, arbitration_id=0x100, data=b"\1", is_extended_id=False),
        can.Message(timestamp=0.1, arbitration_id=0x100, is_remote_frame=True, is_extended_id=False, dlc=2),
        can.Message(timestamp=0.2, arbitration_id=0x100, is_fd=True, data=bytes(12), is_extended_id=False),
    )
    log = read_bus_log(path)
    assert log.traffic.tolist() == [[0, 0x100, 1, 1]]
    assert log.left_out == Counter({"remote": 1, "CAN FD": 1})


def test_one_of_several_channels_has_to_be_chosen(tmp_path):
    messages = [can.Message(timestamp=0.0, arbitration_id=i, channel=f"can{i}") for i in range(2)]
    path = log_of(tmp_path / "bus.log", *messages, can.Message(timestamp=0.1, is_error_frame=True))
    with pytest.raises(BenchError, match="more than one channel is in it: choose one of can0, can1"):
        read_bus_log(path)
    with pytest.raises(BenchError, match="no channel 'can2' is in it"):
        read_bus_log(path, "can2")
    assert read_bus_log(path, "can1").traffic[:, 1].tolist() == [EFF_FLAG | 1, ERR_FLAG]


# what is no log


@pytest.mark.parametrize("suffix", [*FORMATS, ".csv", ".trc", ".log.gz"])
@pytest.mark.parametrize("content", [b"", b"not a log\n", bytes(range(256)) * 8])
def test_a_file_that_is_no_log_is_refused_in_one_line(tmp_path, suffix, content):
    path = tmp_path / f"bus{suffix}"
    path.write_bytes(content)
    with pytest.raises(BenchError) as refused:
        read_bus_log(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_is_not_there(tmp_path, suffix):
    with pytest.raises(BenchError, match=r"cannot be read \(No such file"):
        read_bus_log(tmp_path / f"bus{suffix}")


@pytest.mark.parametrize("name", ["bus.xyz", "bus", "bus.gz"])
def test_an_unknown_suffix_names_the_known_ones(tmp_path, name):
    with pytest.raises(BenchError, match=r"choose one of \.asc, \.blf, .*\.mf4"):
        read_bus_log(tmp_path / name)


# what was cut off


@pytest.fixture(scope="module")
def whole_logs(tmp_path_factory) -> tuple[np.ndarray, dict[str, bytes]]:
    """Return frames, and a log of them in each format."""
    folder = tmp_path_factory.mktemp("logs")
    rng = np.random.default_rng(1)
    traffic = np.array([(i * 1_000_000, 0x100, 8, int(rng.integers(2**63))) for i in range(300)], np.uint64)
    contents = {}
    for suffix in (*FORMATS, ".csv", ".trc"):
        write_bus_log(folder / f"bus{suffix}", traffic)
        contents[suffix] = (folder / f"bus{suffix}").read_bytes()
        contents[f"{suffix}.gz"] = gzip.compress(contents[suffix])
    return traffic, contents


@pytest.mark.parametrize("packed", ["", ".gz"])
@pytest.mark.parametrize("suffix", [*FORMATS, ".csv", ".trc"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_log_that_was_cut_off_is_refused_or_says_so_and_gives_the_intact_frames(
    tmp_path, whole_logs, suffix, packed, share
):
    traffic, contents = whole_logs
    content = contents[suffix + packed]
    left = content[: int(share * len(content))]
    has_no_mark_of_its_end = suffix in (".log", ".csv", ".trc") and not packed
    assume(not (has_no_mark_of_its_end and left.endswith(b"\n")))
    path = tmp_path / f"bus{suffix}{packed}"
    path.write_bytes(left)
    try:
        log = read_bus_log(path)
    except BenchError:
        return
    assert log.damage
    assert "\n" not in log.damage
    assert np.array_equal(log.traffic[:, 1:], traffic[: len(log.traffic), 1:])


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_what_is_intact_of_a_log_that_was_cut_off_is_read(tmp_path, whole_logs, suffix):
    traffic, contents = whole_logs
    path = tmp_path / f"bus{suffix}"
    path.write_bytes(contents[suffix][: len(contents[suffix]) // 2])
    assert len(traffic) // 3 < len(read_bus_log(path).traffic) < len(traffic) * 2 // 3


@pytest.mark.parametrize("suffix", [*FORMATS, ".csv", ".trc"])
def test_a_whole_log_is_not_damaged(tmp_path, whole_logs, suffix):
    path = tmp_path / f"bus{suffix}"
    path.write_bytes(whole_logs[1][suffix])
    assert read_bus_log(path).damage == ""


def test_a_spoiled_line_ends_what_is_read(tmp_path, whole_logs):
    traffic, contents = whole_logs
    lines = contents[".log"].splitlines(keepends=True)
    lines[100] = b"(0.1) can0 nonsense\n"
    path = tmp_path / "bus.log"
    path.write_bytes(b"".join(lines))
    log = read_bus_log(path)
    assert np.array_equal(log.traffic, traffic[:100])
    assert log.damage


def test_a_log_whose_writer_was_killed_is_damaged(tmp_path):
    """python-can writes the size of a .blf into its header when it closes the file."""
    path = tmp_path / "bus.blf"
    message = can.Message(timestamp=0.0, arbitration_id=0x100, data=b"\1", is_extended_id=False)
    writer = can.Logger(path, max_container_size=48)
    writer.on_message_received(message)
    writer.file.close()
    log = read_bus_log(path)
    assert log.traffic.tolist() == [[0, 0x100, 1, 1]]
    assert log.damage == f"{path.stat().st_size} bytes, 144 in its header"


# .mf4 on demand


def test_programs_load_the_package_for_mf4_when_it_is_asked_for_and_not_before():
    program = (
        "import sys, hil.bus.mf4_on_demand as on_demand, hil.cli\n"
        "assert 'asammdf' not in sys.modules\n"
        "assert on_demand.load_mf4()\n"
        "assert 'asammdf' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=SAFETY_NET_S)


def test_the_command_line_writes_mf4(tmp_path):
    out = tmp_path / "out"
    ended = hil("run", "sine", "--mode", "inprocess", "--duration", "0.1", "--log", ".mf4", "--out", str(out))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert len(read_bus_log(out / "bus.mf4").traffic) > 500
