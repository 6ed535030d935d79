"""Damaged files of every type: a reader returns or raises its own error, in bounded memory."""

from __future__ import annotations

import functools
import io
import struct
import tempfile
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.files.captures import read_capture
from jointfit_daemon.files.captures._capture import UnreadableCaptureError
from jointfit_daemon.files.mocap import MarkerTrajectories, c3d_bytes, read_trc, write_trc
from jointfit_daemon.files.mocap._c3d import read_c3d
from jointfit_daemon.files.models import read_osim
from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    TimeTable,
    read_orientations_npz,
    read_orientations_sto,
    read_sto,
    write_orientations_npz,
    write_orientations_sto,
    write_sto,
)
from jointfit_daemon.files.text import MalformedFileError
from jointfit_simulators.body import SimulatedSubject, Step
from jointfit_simulators.sample._sample_data import _write_models
from jointfit_simulators.settings import Knobs
from tests.captured_datagrams import read_udp

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MOST_BYTES = 64 << 20
"""Maximum memory of a reader for a file of a few kilobytes, bytes."""
ROWS = 8
T_S = np.arange(ROWS) / 50.0
POSITIONS = np.random.default_rng(1).normal(size=(ROWS, 3, 3))
UNIT = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))


def trc(path: Path) -> None:
    names = ("A", "B", "C")
    write_trc(path, MarkerTrajectories(names, T_S, np.arange(1, ROWS + 1), POSITIONS, 50.0))


def sto(path: Path) -> None:
    write_sto(path, TimeTable(("a", "b"), T_S, POSITIONS[:, 0, :2], in_degrees=True))


def orientations(path: Path) -> None:
    write_orientations_sto(path, OrientationTable(("A",), T_S, UNIT[:, None], 50.0))


def npz(path: Path) -> None:
    write_orientations_npz(path, OrientationTrial(T_S, {"A": UNIT}, {"thigh": UNIT}, {}))


def c3d(path: Path) -> None:
    path.write_bytes(c3d_bytes(("A", "B", "C"), POSITIONS, rate_hz=50.0, up="z"))


@functools.cache
def model() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        subject = SimulatedSubject(Knobs(), [Step("stand", 1.0)])
        _write_models(Path(folder), Knobs(), subject)
        return (Path(folder) / "leg.osim").read_bytes()


def osim(path: Path) -> None:
    path.write_bytes(model())


def candump(path: Path) -> None:
    lines = [f"(14365090{k:02}.249713) can0 105#2A366C2B\n" for k in range(ROWS)]
    path.write_text("".join(lines))


def udp(identifier: int, offset: int, payload: bytes, *, more: bool) -> bytes:
    """Return one pcap record of a raw IP packet with a fragment of a UDP datagram."""
    flags = more << 13 | offset // 8
    head = struct.pack(
        ">BBHHHBBHII", 0x45, 0, 20 + len(payload), identifier, flags, 64, 17, 0, 0x7F000001, 1
    )
    return struct.pack("<IIII", 1, 0, 20 + len(payload), 20 + len(payload)) + head + payload


PCAP_HEAD = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)


def pcap(path: Path) -> None:
    whole = struct.pack(">HHHH", 1, 2, 24, 0) + bytes(16)
    fragments = [udp(7, 0, whole[:16], more=True), udp(7, 16, whole[16:], more=False)]
    path.write_bytes(PCAP_HEAD + udp(1, 0, whole, more=False) + b"".join(fragments))


def captured(wire: str) -> Callable[[Path], object]:
    return lambda path: list(read_capture(path, wire))  # type: ignore[arg-type]


READERS: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "trc": (".trc", trc, read_trc),
    "sto": (".sto", sto, read_sto),
    "orientations": (".sto", orientations, read_orientations_sto),
    "npz": (".npz", npz, read_orientations_npz),
    "c3d": (".c3d", c3d, read_c3d),
    "osim": (".osim", osim, read_osim),
    "candump": (".log", candump, captured("can")),
    "pcap": (".pcap", pcap, captured("datagram")),
}
REPLACEMENTS = [b"", b"\0", b"\xff\xff\xff\x7f", b"-1", b"1e999", b"nan", b"9" * 20, b"\t" * 50,
                b",", b"\n", b"=", b"\xef\xbb\xbf", b"1,5"]  # fmt: skip
EDITS = st.lists(
    st.tuples(
        st.floats(0.0, 1.0),
        st.integers(0, 8),
        st.sampled_from(REPLACEMENTS) | st.binary(max_size=4),
    ),
    min_size=1,
    max_size=6,
)


def edited(data: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    for share, removed, put in edits:
        at = round(share * len(data))
        data = data[:at] + put + data[at + removed :]
    return data


def outcome(read: Callable[[Path], object], path: Path) -> str:
    """Read a file; return the message of the reader's own error, or "" without an error.

    Fail for other exceptions, and for a peak memory of `MOST_BYTES` or more.
    """
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(path)
        message = ""
    except (MalformedFileError, UnreadableCaptureError) as error:
        message = str(error)
        assert str(path) in message
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < MOST_BYTES
    return message


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


@pytest.mark.parametrize("kind", READERS)
@given(edits=EDITS)
@settings(max_examples=150, suppress_health_check=list(HealthCheck))
def test_a_damaged_file_is_read_or_refused(
    folder: Path, kind: str, edits: list[tuple[float, int, bytes]]
) -> None:
    suffix, write, read = READERS[kind]
    path = folder / f"{kind}{suffix}"
    write(path)
    path.write_bytes(edited(path.read_bytes(), edits))
    outcome(read, path)


def npz_claiming(shape: str, data: bytes = b"") -> bytes:
    """Return an NPZ file whose array ``t`` declares a shape, independent of its content."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", array)
        archive.writestr("A_quat.npy", array)
    return file.getvalue()


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", "(-1,)", "()", "(2**70,)", "('x',)", "(3, 0)"]
)
def test_array_needs_no_more_memory_than_its_data(tmp_path: Path, shape: str) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(npz_claiming(shape))
    assert outcome(read_orientations_npz, path)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_daemon.files.orientations._npz.LARGEST", 1 << 20)
    path = tmp_path / "a.npz"
    path.write_bytes(npz_claiming("(1000000,)", bytes(8_000_000)))
    assert path.stat().st_size < 100_000
    assert "unpacked" in outcome(read_orientations_npz, path)


def test_pickled_array_is_rejected_without_advice_to_load_it(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, allow_pickle=True, t=np.array([{}], dtype=object), A_quat=UNIT)
    message = outcome(read_orientations_npz, path)
    assert "without Python objects" in message
    assert "pickle" not in message.removeprefix(str(path))


@pytest.mark.parametrize("kind", ["trc", "sto", "orientations"])
def test_a_wide_header_over_many_short_rows_takes_no_vast_memory(tmp_path: Path, kind: str) -> None:
    suffix, write, read = READERS[kind]
    path = tmp_path / f"wide{suffix}"
    write(path)
    lines = path.read_text().splitlines()
    names = next(k for k, line in enumerate(lines) if line.startswith(("Frame#", "time")))
    lines[names] += "".join(f"\tm{k}" for k in range(20_000))
    lines += ["9.0" if kind == "orientations" else "9\t9.0"] * 20_000
    path.write_text("\n".join(lines))
    assert "row of names" in outcome(read, path)


def test_fragments_of_a_datagram_cost_linear_time(tmp_path: Path) -> None:
    def seconds(count: int) -> float:
        packets = b"".join(udp(7, 8 + 8 * (k % 8000), bytes(8), more=True) for k in range(count))
        data = PCAP_HEAD + packets
        began = time.thread_time()  # CPU time of this thread only
        assert list(read_udp(data)) == []
        return time.thread_time() - began

    assert min(seconds(16_000) for _ in range(3)) < 12 * max(seconds(4_000), 0.01)


def messages() -> Iterator[tuple[str, Callable[[bytes], bytes], str]]:
    yield "trc", lambda data: data.replace(b".", b","), "decimal comma"
    yield "sto", lambda data: data.replace(b".", b","), "decimal comma"
    yield "orientations", lambda data: data.replace(b"1", b"0,9"), "decimal commas"
    yield "trc", lambda data: b"\n".join(data.split(b"\n")[:6]) + b"\n", "contains no rows"
    yield "sto", lambda data: b"\n".join(data.split(b"\n")[:7]) + b"\n", "contains no rows"
    yield (
        "trc",
        lambda data: data.replace(b"\t50\t", b"\t0\t", 1).replace(b"50", b"0", 1),
        "DataRate",
    )
    yield "trc", lambda data: data.decode().encode("utf-16"), "UTF-16"
    yield "npz", lambda data: data[: len(data) // 2], "export it again"
    yield "npz", lambda data: data[::-1], "export it again"
    yield "c3d", lambda data: data[:100], "export it again"


@pytest.mark.parametrize(("kind", "damage", "remedy"), list(messages()))
def test_the_message_names_the_fault_and_the_remedy(
    tmp_path: Path, kind: str, damage: Callable[[bytes], bytes], remedy: str
) -> None:
    suffix, write, read = READERS[kind]
    path = tmp_path / f"bad{suffix}"
    write(path)
    path.write_bytes(damage(path.read_bytes()))
    assert remedy in outcome(read, path)


@pytest.mark.parametrize("kind", ["trc", "sto", "orientations"])
def test_a_byte_order_mark_is_skipped(tmp_path: Path, kind: str) -> None:
    suffix, write, read = READERS[kind]
    path = tmp_path / f"bom{suffix}"
    write(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert outcome(read, path) == ""


@pytest.mark.parametrize("kind", READERS)
def test_endless_device_file_is_rejected(tmp_path: Path, kind: str) -> None:
    suffix, _, read = READERS[kind]
    path = tmp_path / f"zero{suffix}"
    path.symlink_to("/dev/zero")
    assert "device" in outcome(read, path)
