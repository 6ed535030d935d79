"""Every command ends with exit code 1 or 2 on bad input, and names the faulty object and a remedy.

The tests combine all commands with all types of damage. A command may succeed if the damaged file
is still usable.
"""

from __future__ import annotations

import io
import os
import random
import socket
import subprocess
import sys
import warnings
import zipfile
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from jointfit_daemon.outputs.mqtt._error_messages import broker_fault
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.embedded_broker import free_port
from jointfit_simulators.sample import write_sample

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

run = CliRunner().invoke

SEGMENTS = ("--segment", "thigh=S1,S2", "--segment", "shank=S3,S4")
MARKERS = ("--markers", "thigh=T1,T2,T3", "--markers", "shank=C1,C2,C3")
IDS = ("--set", "ids={sample_time=0x205,group_counter=0x206,quaternion=0x221}")
BAD = "BAD"
"""Placeholder for the damaged file in a command."""

COMMANDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "center trc": (
        "squats.trc",
        ".trc",
        ("center", BAD, "--parent", "T1,T2,T3", "--markers", "C1,C2,C3"),
    ),
    "center c3d": (
        "squats.c3d",
        ".c3d",
        ("center", BAD, "--parent", "T1,T2,T3", "--markers", "C1,C2,C3"),
    ),
    "markers trial": ("standing.trc", ".trc", ("markers", BAD, "--model", "leg.toml")),
    "markers toml": ("leg.toml", ".toml", ("markers", "standing.trc", "--model", BAD)),
    "markers json": ("leg.toml", ".json", ("markers", "standing.trc", "--model", BAD)),
    "markers osim": ("leg.osim", ".osim", ("markers", "standing.trc", "--model", BAD)),
    "ik trial": ("standing.trc", ".trc", ("ik", BAD, "leg.toml", "--end", "0.1")),
    "ik osim": ("leg.osim", ".osim", ("ik", "standing.trc", BAD, "--end", "0.1")),
    "fuse npz": ("standing.npz", ".npz", ("fuse", "evaluate", BAD, *SEGMENTS)),
    "fuse sto": (
        "standing.sto",
        ".sto",
        ("fuse", "evaluate", f"{BAD}=standing.npz", *SEGMENTS),
    ),
    "fuse reference": (
        "standing.trc",
        ".trc",
        (
            *("fuse", "evaluate", f"standing.npz={BAD}", *SEGMENTS, *MARKERS),
            *("--static", "standing.npz=standing.trc"),
        ),
    ),
    "fuse static": (
        "leg.toml",
        ".json",
        ("fuse", "evaluate", "standing.npz", *SEGMENTS, "--static", BAD),
    ),
    "fuse apply": ("leg.toml", ".json", ("fuse", "apply", BAD, "standing.npz", "--out", "o.csv")),
    "decode xbus": ("xbus.bin", ".bin", ("decode", "xbus", BAD)),
    "decode xcdi": ("can.log", ".log", ("decode", "xcdi", BAD, *IDS)),
    "decode natnet": ("cameras.pcap", ".pcap", ("decode", "natnet", BAD)),
    "check": ("rig.toml", ".toml", ("check", BAD)),
    "calibrate": ("rig.toml", ".toml", ("calibrate", BAD, "--yes")),
}


def archive(*names: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        for name in names:
            made.writestr(name, b"")
    return file.getvalue()


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "zeros": lambda _: bytes(5000),
    "noise": lambda _: random.Random(1).randbytes(3000),
    "a byte order mark": lambda good: b"\xef\xbb\xbf" + good,
    "UTF-16": lambda good: good.decode("latin1").encode("utf-16"),
    "half": lambda good: good[: len(good) // 2],
    "one line": lambda good: good.split(b"\n")[0] + b"\n",
    "header only": lambda good: b"\n".join(good.split(b"\n")[:6]) + b"\n",
    "decimal commas": lambda good: good.replace(b".", b","),
    "letters for digits": lambda good: good.replace(b"0", b"x"),
    "vast numbers": lambda good: good.replace(b"1", b"9" * 30),
    "nan glued to digits": lambda good: good.replace(b"0.", b"nan"),
    "another separator": lambda good: good.replace(b"\t", b","),
    "a changed head": lambda good: bytes(byte ^ 0x55 for byte in good[:512]) + good[512:],
    "a web page": lambda _: b"<!DOCTYPE html><html><body>404</body></html>",
    "entities": lambda _: b'<!DOCTYPE l [<!ENTITY a "aaaa">]><l>&a;</l>',
    "deep XML": lambda _: b"<a>" * 20_000,
    "deep JSON": lambda _: b"[" * 50_000,
    "deep TOML": lambda _: b"a = " + b"[" * 50_000,
    "many digits": lambda _: b"1" * 50_000,
    "an archive of nothing": lambda _: archive("t.npy", "S1_quat.npy"),
    "a pickle": lambda _: b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00}\x94\x8c\x01a\x94K\x01s.",
}

OBJECTS = ("--parent", "marker", "trials", "refused")
"""Objects that a message may name instead of the file if the file can be read."""
LIBRARY_TEXT = ("could not convert", "codec can't", "allow_pickle", "reshape", "Errno", "[code:",
                "unpack requires", "C3D magic", "no element found", "not well-formed", "CRC-32",
                "zip file", "NoneType", "Traceback", "array of size")  # fmt: skip
"""Parts of library messages that do not help a user."""


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    write_sample(folder, force=True)
    return folder


@pytest.fixture(autouse=True)
def in_the_sample(sample: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sample)


def fault_of(words: Sequence[str], *named: str) -> str:
    """Run a command; return its error message, or an empty text if the command succeeds.

    The message must contain one of the texts `named`, and no text of a library.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning of a library does not help a user either
        result = run(app, list(words))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    if result.exit_code == 0:
        return ""
    assert result.exit_code in (1, 2)
    message = result.stderr or result.stdout  # some commands print a refusal on stdout
    assert any(name in message for name in named), message
    assert not [word for word in LIBRARY_TEXT if word in message], message
    assert "Warning" not in message
    return message


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files(tmp_path: Path, sample: Path, command: str, damage: str) -> None:
    good, suffix, words = COMMANDS[command]
    bad = tmp_path / f"bad{suffix}"
    bad.write_bytes(DAMAGES[damage]((sample / good).read_bytes()))
    if command == "calibrate":  # a valid rig must not connect to a broker
        words = ("check", *words[1:2])
    fault_of([word.replace(BAD, str(bad)) for word in words], "bad", *OBJECTS)


LINKS = {"a dangling link": "none", "a device": "/dev/zero"}
PATHS = ("missing", "a folder", "a circle of links", *LINKS, "too long a name")


def no_file(folder: Path, suffix: str, kind: str) -> Path:
    path = folder / f"bad{suffix}"
    if kind == "a folder":
        path.mkdir()
    elif kind == "too long a name":
        return path.with_stem("bad" * 100)
    elif kind == "a circle of links":
        path.symlink_to(path)
    elif kind in LINKS:
        path.symlink_to(LINKS[kind])
    return path


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("kind", PATHS)
def test_paths_that_are_no_files(tmp_path: Path, command: str, kind: str) -> None:
    _, suffix, words = COMMANDS[command]
    path = no_file(tmp_path, suffix, kind)
    assert fault_of([word.replace(BAD, str(path)) for word in words], "bad")


OUTPUTS = {
    "center": ("center", "squats.trc", "--parent", "T1,T2,T3", "--markers", "C1,C2,C3", "--plot"),
    "markers plot": ("markers", "standing.trc", "--model", "leg.toml", "--plot"),
    "markers out": ("markers", "standing.trc", "--model", "leg.toml", "--out"),
    "evaluate": ("fuse", "evaluate", "squats.npz", *SEGMENTS, "--plot"),
    "fit": ("fuse", "fit", "squats.npz", *SEGMENTS, "--out"),
    "apply": ("fuse", "apply", "model.json", "squats.npz", "--out"),
    "demo": ("demo", "--picture"),
}
ENDINGS = {"markers out": ".toml", "fit": ".json", "apply": ".csv", "demo": ".svg"}


@pytest.mark.parametrize("command", OUTPUTS)
def test_output_files_are_checked_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def work(*_: object, **__: object) -> None:
        raise AssertionError("the work began")

    # Replace the functions only in the modules that use them. If the defining modules were changed,
    # a module imported during the test would retain the replacement.
    for reader in ("jointfit_daemon.tools.markers._trials.read_marker_trial",
                   "jointfit_daemon.tools.fuse._trial.read_recording",
                   "jointfit_daemon.files.mocap.read_marker_trial",
                   "jointfit_daemon.tools.demo._command._run"):  # fmt: skip
        monkeypatch.setattr(reader, work)
    ending = ENDINGS.get(command, ".png")
    (tmp_path / f"folder{ending}").mkdir()
    words = OUTPUTS[command]
    assert "mkdir" in fault_of([*words, str(tmp_path / f"none/out{ending}")], "none")
    assert "expected a file name" in fault_of([*words, str(tmp_path / "out.xyz")], "out.xyz")
    assert "found a folder" in fault_of([*words, str(tmp_path / f"folder{ending}")], "folder")
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "permission" in fault_of([*words, str(tmp_path / f"locked/out{ending}")], "locked")


OPTIONS: list[tuple[tuple[str, ...], str]] = [
    (("check",), "rig.toml"),
    (("calibrate", "rig.toml", "--phase", "dance"), "functional"),
    (("calibrate", "rig.toml", "--seconds", "nan"), "--seconds"),
    (("calibrate", "rig.toml", "--seconds", "0"), "--seconds"),
    (("calibrate", "rig.toml", "--seconds", "1e9"), "--seconds"),
    (("demo", "--seconds", "-1"), "--seconds"),
    (("demo", "--seconds", "inf"), "--seconds"),
    (("demo", "--seed", "x"), "--seed"),
    (("center", "squats.trc", "--parent", "T1,T2", "--markers", "C1"), "--parent"),
    (("center", "squats.trc", "--parent", "T1,T2,T1", "--markers", "C1"), "--parent"),
    (("center", "squats.trc", "--parent", "T1,T2,T3", "--markers", "T3"), "T3"),
    (("center", "squats.trc", "--parent", "T1,T2,X9", "--markers", "C1"), "X9"),
    (("center", "squats.trc", "--parent", "T1,P1,C3", "--markers", "C1"), "T1"),
    (("center", "squats.trc", "--parent", "", "--markers", ""), "--parent"),
    (("center", "squats.trc", "--parent", "T1,T2,T3", "--markers", "C1", "--up", "w"), "--up"),
    (("center", "squats.trc", "--parent", "T1,T2,T3", "--markers", "C1", "--method", "?"), "?"),
    (("center", "squats.npz", "--parent", "T1,T2,T3", "--markers", "C1"), ".c3d"),
    (("markers", "squats.trc", "--model", "leg.toml", "--lock", "X9"), "X9"),
    (("markers", "squats.trc", "--model", "leg.toml", "--method", "?"), "--method"),
    (("markers", "squats.trc", "--model", "leg.toml", "--prior", "-1"), "--prior"),
    (("fuse", "fit", "squats.npz", *SEGMENTS, "--out", "m.json", "--method", "?"), "?"),
    (("fuse", "evaluate", "squats.npz", "--segment", "thigh"), "--segment"),
    (("fuse", "evaluate", "squats.npz", "--segment", "thigh=S1,S9"), "S9"),
    (("fuse", "evaluate", "squats.npz", *SEGMENTS, "--joints", "a"), "--joints"),
    (("fuse", "evaluate", "squats.npz", "squats.npz", *SEGMENTS), "squats.npz"),
    (("fuse", "evaluate", "squats.trc", *SEGMENTS), ".npz"),
    (("fuse", "evaluate", "squats.npz", *SEGMENTS, "--up", "x"), "--up"),
    (("decode", "xbux", "xbus.bin"), "xbus"),
    (("decode", "xbus", "xbus.bin", "--set", "baud"), "KEY=VALUE"),
    (("decode", "xbus", "xbus.bin", "--set", "bawd=1"), "bawd"),
    (("decode", "xbus", "xbus.bin", "--set", "baud=x"), "baud"),
    (("decode", "xbus", "xbus.bin", "--set", f"baud={'[' * 9000}"), "nested more than 32"),
    (("decode", "xbus", "xbus.bin", "--set", f"baud={'[' * 40}{']' * 40}"), "nested more than 32"),
    (("decode", "xbus", "xbus.bin", "--set", f"{'a.' * 9000}b=1"), "nested more than 32"),
    (("decode", "xbus", "xbus.bin", "--set", f"baud={2**64}"), "more than 64 bits"),
    (("calibrate", "rig.toml", "--abort", "--phase", "static"), "--abort"),
    (("calibrate", "rig.toml", "--recording", "trial.mcap"), "--rig rig.toml"),
    (("calibrate", "a.toml", "--rig", "b.toml", "--recording", "trial.mcap"), "a.toml"),
    (("center-study", "--repeats", "0"), "--repeats"),
    (("center-study", "--out", "leg.toml"), "leg.toml"),
    (("sample", "leg.toml"), "leg.toml"),
    (("sample", "."), "--force"),
    (("chekc",), "chekc"),
]


@pytest.mark.parametrize(("words", "named"), OPTIONS, ids=lambda words: " ".join(words)[:60])
def test_wrong_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], named: str
) -> None:
    if words == ("check",):
        monkeypatch.chdir(tmp_path)
    assert fault_of(words, named)


def test_suggestion_for_a_misspelt_marker_is_none_of_the_requested_ones() -> None:
    message = fault_of(["center", "squats.trc", "--parent", "T1,T2,T33", "--markers", "C1"], "T33")
    assert "did you mean 'T3' or 'T4'?" in message or "did you mean 'T3'?" in message


SIMULATOR: list[tuple[tuple[str, ...], str]] = [
    (("play",), "--directory"),
    (("play", "--directory", "leg.toml"), "leg.toml"),
    (("play", "--directory", "d", "--programme", "hop"), "hop"),
    (("play", "--directory", "d", "--programme", "walk:x"), "walk:x"),
    (("play", "--directory", "d", "--set", "dropout"), "dropout"),
    (("play", "--directory", "d", "--set", "dropout=x"), "dropout"),
    (("play", "--directory", "d", "--knobs", "none.toml"), "none.toml"),
    (("play", "--directory", "d", "--knobs", "xbus.bin"), "xbus.bin"),
    (("play", "--directory", "d", "--clock", "S1"), "--clock"),
    (("play", "--directory", "d", "--clock", "S1=x"), "S1"),
    (("play", "--directory", "d", "--clock", "S9=5"), "S9"),
    (("play", "--directory", "d", "--at", "5"), "--at"),
    (("play", "--directory", "d", "--at", "x=quit"), "--at"),
    (("play", "--directory", "d", "--motion", "kick"), "--motion"),
    (("play", "--directory", "d", "--motion", "kick=none.mot"), "none.mot"),
    (("play", "--directory", "d", "--trial", "none.npz"), "none.npz"),
    (("play", "--directory", "d", "--trial", "xbus.bin"), "xbus.bin"),
    (("play", "--directory", "d", "--command-port", "99999"), "--command-port"),
    (("play", "--directory", "d", "--rate", "0"), "rate"),
    (("hop",), "hop"),
]


@pytest.mark.parametrize(("words", "named"), SIMULATOR, ids=lambda words: " ".join(words)[:60])
def test_wrong_options_of_the_simulator(
    capfd: pytest.CaptureFixture[str], words: tuple[str, ...], named: str
) -> None:
    from jointfit_simulators.__main__ import main  # noqa: PLC0415 - starts slowly

    try:
        code = main(words)
    except SystemExit as end:
        code = int(str(end.code))
    message = capfd.readouterr().err
    assert code == 2, message
    assert named in message
    assert not [word for word in (*LIBRARY_TEXT, "not enough values") if word in message], message


@pytest.mark.system
@pytest.mark.parametrize("words", [("--config", "none.toml"), ("--config", "xbus.bin"), ()])
def test_daemon_rejects_an_invalid_rig(words: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "jointfit_daemon", *words, "--check"],
        capture_output=True, check=False, text=True,
    )  # fmt: skip
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert (words[-1] if words else "--config") in done.stderr


def test_refused_connection_is_reported_with_a_remedy(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    text = Path("rig.toml").read_text()
    rig.write_text(text.replace("port = 1883", f"port = {free_port()}"))
    message = fault_of(["calibrate", str(rig), "--yes", "--phase", "static"], "127.0.0.1")
    assert "start the broker" in message


def test_refused_credentials_are_reported_without_an_error_number(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
        text = Path("rig.toml").read_text().replace("port = 1883", f"port = {port}")
        rig.write_text(text.replace('version = "5"', 'version = "3.1.1"'))
        refusing = subprocess.Popen(
            [sys.executable, "-c", REFUSE, str(server.fileno())], pass_fds=[server.fileno()]
        )
        try:
            message = fault_of(["calibrate", str(rig), "--yes", "--phase", "static"], str(port))
        finally:
            refusing.kill()
            refusing.wait()
    assert "password" in message


REFUSE = (
    "import socket, sys\n"
    "link, _ = socket.socket(fileno=int(sys.argv[1])).accept()\n"
    "link.recv(4096)\n"
    "link.sendall(bytes([0x20, 2, 0, 4]))\n"  # CONNACK: bad user name or password
    "link.recv(1)\n"
)


@pytest.mark.parametrize("text", ["[Errno 111] x", "[Errno 104] x", "[Errno -2] x", "[code:4] x",
                                  "[code:135] x", "[code:132] x"])  # fmt: skip
def test_faults_of_a_broker_have_words(text: str) -> None:
    said = broker_fault(OSError(text))
    assert "[" not in said.replace("[mqtt]", "")
    assert len(said) > 30


def test_an_unknown_fault_of_a_broker_keeps_its_text() -> None:
    assert broker_fault(OSError("strange")) == "strange"


def test_an_unknown_code_of_a_broker_is_in_its_log() -> None:
    said = broker_fault(OSError("[code:250] strange"))
    assert said == "the broker ended the connection with code 250: check its log"
