"""Fuzz targets of the files that the tools read: trials, models and captures."""

from __future__ import annotations

import io
import json
import tempfile
import tomllib
import zipfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.captures import read_capture
from jointfit_daemon.files.captures._candump import read_candump
from jointfit_daemon.files.mocap import c3d_bytes, read_trc
from jointfit_daemon.files.mocap._c3d import read_c3d
from jointfit_daemon.files.models import read_model, read_osim
from jointfit_daemon.files.orientations import (
    read_orientations_npz,
    read_orientations_sto,
    read_sto,
)
from jointfit_protocols import qtm
from jointfit_simulators.sample import write_sample
from tests.files.captures.test_capture import pcap
from tests.files.captures.test_tcp_streams import SYN, tcp
from tests.fuzz.broker_targets import folder
from tests.fuzz.target import Target

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_daemon.model import Chunk


@cache
def samples() -> dict[str, bytes]:
    """Return the contents of the sample files of the simulators, by file name."""
    with tempfile.TemporaryDirectory() as name:
        write_sample(Path(name))
        return {path.name: path.read_bytes() for path in Path(name).iterdir() if path.is_file()}


def lines_of(suffix: str, count: int = 12) -> list[bytes]:
    """Return the beginnings of the sample files of a kind."""
    return [
        b"\n".join(data.split(b"\n")[:count]) + b"\n"
        for name, data in samples().items()
        if name.endswith(suffix)
    ]


def reading(suffix: str, read: Callable[[Path], object]) -> Callable[[bytes], None]:
    """Return a target that writes its input to a file and reads it."""

    def run(data: bytes) -> None:
        path = folder() / f"input{suffix}"
        path.write_bytes(data)
        read(path)

    return run


def count(chunks: Iterable[Chunk]) -> int:
    """Return the number of chunks."""
    return sum(1 for _ in chunks)


def read_captures(path: Path) -> None:
    """Read a file as a capture of a stream, of datagrams and of CAN frames."""
    for wire in ("stream", "datagram", "can"):
        try:
            for _ in read_capture(path, wire):
                pass
            for _ in read_capture(path, wire, split=qtm.QtmStream, rate=count):
                pass
        except ValueError:
            continue


def run_npz_members(data: bytes) -> None:
    """Read a ZIP archive with valid checksums, whose arrays are parts of the input."""
    packed = io.BytesIO()
    third = len(data) // 3
    with zipfile.ZipFile(packed, "w") as archive:
        for number, name in enumerate(("t.npy", "S1_quat.npy", "up.npy")):
            archive.writestr(name, data[number * third : (number + 1) * third])
    path = folder() / "members.npz"
    path.write_bytes(packed.getvalue())
    read_orientations_npz(path)


def seeds_npz_members() -> list[bytes]:
    """Return the NPY members of a small trial, padded to one size."""
    arrays = (np.arange(2.0), np.tile((1.0, 0.0, 0.0, 0.0), (2, 1)), np.array("z"))
    found = []
    for array in arrays:
        member = io.BytesIO()
        np.save(member, array, allow_pickle=False)
        found.append(member.getvalue())
    longest = max(map(len, found))
    return [b"".join(member.ljust(longest, b"\0") for member in found)]


def seeds_npz() -> list[bytes]:
    """Return a small trial."""
    packed = io.BytesIO()
    np.savez(packed, t=np.arange(2.0), S1_quat=np.tile((1.0, 0.0, 0.0, 0.0), (2, 1)), up="z")
    return [packed.getvalue()]


def seeds_c3d() -> list[bytes]:
    """Return a file of two markers and three frames."""
    return [c3d_bytes(("A", "B"), np.ones((3, 2, 3)), rate_hz=100.0, up="+Y")]


def seeds_model_json() -> list[bytes]:
    """Return the sample model as JSON."""
    return [json.dumps(tomllib.loads(samples()["leg.toml"].decode())).encode()]


def seeds_capture() -> list[bytes]:
    """Return the beginnings of captures of every kind."""
    command = qtm.encode(qtm.Command("Version 1.25"))
    segments = [tcp(b"", 99, flags=SYN), tcp(command[:9], 100), tcp(command[9:], 109)]
    connection = pcap(list(enumerate(segments)), link=101)
    files = [data for name, data in samples().items() if name.endswith((".pcap", ".bin"))]
    return [data[:1500] for data in (*files, connection)]


def run_candump(data: bytes) -> None:
    """Read the text of candump."""
    list(read_candump(data))


_FILES = (ValueError, OSError)
TARGETS = (
    Target("trc", reading(".trc", read_trc), lambda: lines_of(".trc"), _FILES, 1.5),
    Target("sto", reading(".sto", read_sto), lambda: lines_of(".sto"), _FILES, 1.5),
    Target("sto-q", reading(".sto", read_orientations_sto), lambda: lines_of(".sto"), _FILES, 1.5),
    Target("c3d", reading(".c3d", read_c3d), seeds_c3d, _FILES, 0.3),
    Target("npz", reading(".npz", read_orientations_npz), seeds_npz, _FILES, 0.3),
    Target("npz-members", run_npz_members, seeds_npz_members, _FILES, 0.3),
    Target("osim", reading(".osim", read_osim), lambda: lines_of(".osim", 400), _FILES, 0.3),
    Target(
        "model-toml", reading(".toml", read_model), lambda: lines_of("leg.toml", 90), _FILES, 0.3
    ),
    Target("model-json", reading(".json", read_model), seeds_model_json, _FILES, 0.5),
    Target("candump", run_candump, lambda: lines_of(".log"), share=8),
    Target("capture", reading(".cap", read_captures), seeds_capture, share=4),
)
