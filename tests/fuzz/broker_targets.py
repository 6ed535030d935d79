"""Fuzz targets of the broker, the configuration and the state directory."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from jointfit_daemon.calibration import CalibrationTrial, SensorTrack
from jointfit_daemon.calibration.phases import fit_static
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.calibration.record import CalibrationFileError, CalibrationStore
from jointfit_daemon.config import MqttSettings, load_rig, parse_rig
from jointfit_daemon.config._fault_messages import ConfigError
from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.mqtt import Incoming, Outbox
from jointfit_daemon.outputs.mqtt._signature import sign_request
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.recording import (
    RecordingError,
    decode_event,
    encode_event,
    read_events,
)
from jointfit_daemon.outputs.spool import SpoolFiles
from jointfit_daemon.outputs.spool._spool_files import SpooledMessage
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    ChunkArrived,
    Configured,
    Reply,
    SourceClosed,
    SourceOpened,
    Tick,
)
from jointfit_daemon.supervisor.requests import (
    RequestAuthenticator,
    parse_request,
)
from tests.fuzz.target import Target
from tests.fuzz.wire_targets import rig
from tests.outputs.recording.recorded_events import write_recording
from tests.pipeline.core_feed import (
    BEGIN_NS,
    PERIOD_NS,
    SENSORS,
    XBUS,
    table,
    xbus_bytes,
    xcdi_bytes,
)

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event

KEY = b"a key for requests, 32 bytes long"
TOPIC = "jointfit/fuzz/bridge/request/"


@cache
def folder() -> Path:
    """Return a temporary directory of this process, in memory if possible."""
    shm = Path("/dev/shm")
    made = Path(tempfile.mkdtemp(prefix="jointfit-fuzz-", dir=shm if shm.is_dir() else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


# --- requests ---------------------------------------------------------------------------------


@cache
def guards() -> tuple[RequestAuthenticator | None, ...]:
    """Return None for a rig without a request key, and the authenticator of a rig with a key."""
    key_file = folder() / "request.key"
    key_file.write_bytes(KEY)
    key_file.chmod(0o600)
    settings = MqttSettings.model_validate({"host": "127.0.0.1", "request_key_file": str(key_file)})
    return None, RequestAuthenticator(settings)


def run_request(data: bytes) -> None:
    """Read an input as topic, response topic, correlation and payload, separated by NUL."""
    parts = data.split(b"\0", 3)
    topic, response, correlation, payload = (parts + [b""] * 4)[:4]
    message = Incoming(
        TOPIC + topic.decode("utf-8", "replace"),
        payload,
        retained=False,
        response_topic=response.decode("utf-8", "replace"),
        correlation=correlation,
    )
    reporter = TopicWriter(rig(), Outbox("b/bridge/state"), UnixClock())
    for guard in guards():
        answer = parse_request(message, guard)
        if isinstance(answer, Reply):
            reporter.output(answer)
        elif answer is not None:
            core = Core()
            for event in (Configured(BEGIN_NS, rig(), None), answer, Tick(answer.t_ns + 10**9)):
                for output in core.feed(event):
                    reporter.output(output)


def seeds_request() -> list[bytes]:
    """Return requests that are valid, signed, unknown, nested and wrong."""
    calibrate = {"phase": "static", "seconds": 3.0, "force": True, "transaction": "a"}
    now_us = time.time_ns() // 1000
    with_key = sign_request(
        KEY, TOPIC + "calibrate", {"phase": "abort", "t_us": now_us, "nonce": "n" * 16}
    )
    payloads = [calibrate, {"phase": "abort"}, {"phase": 5, "x": [[[]]]}, with_key]
    found = [
        b"calibrate\0jointfit/fuzz/bridge/response/calibrate/a\0\x01\0" + orjson.dumps(item)
        for item in payloads
    ]
    found += [
        b'mark\0\0\0{"text":"a"}',
        b'rate\0\0\0{"hz":50}',
        b'use-calibration\0\0\0{"version":1}',
    ]
    return [*found, b"other\0\0\0{}", b"calibrate\0#\0\0" + b"[" * 900, b"calibrate\0a/b\0\0\xff"]


# --- configuration ----------------------------------------------------------------------------


def run_rig(data: bytes) -> None:
    """Load a rig.toml as the daemon does, and publish its description."""
    path = folder() / "rig.toml"
    path.write_bytes(data)
    loaded = load_rig(path)
    core, reporter = Core(), TopicWriter(loaded, Outbox("b/bridge/state"), UnixClock())
    for output in core.feed(Configured(BEGIN_NS, loaded, None)):
        reporter.output(output)
    encode_event(Configured(BEGIN_NS, loaded, None))


def seeds_rig() -> list[bytes]:
    """Return the examples of the project."""
    examples = Path(__file__).resolve().parents[2] / "examples"
    return [path.read_bytes() for path in sorted(examples.glob("*.toml"))]


# --- calibrations -----------------------------------------------------------------------------


@cache
def good_calibration() -> Calibration:
    """Return a calibration of the rig of `core_feed`."""
    t_ns = np.arange(300, dtype=np.int64) * 10_000_000
    still = np.tile((1.0, 0.0, 0.0, 0.0), (len(t_ns), 1))
    trial = CalibrationTrial({name: SensorTrack(t_ns, still) for name in SENSORS}, None)
    pose = fit_static(trial, rig().calibration, rig().chain)
    return fit_static_only(pose, None, rig().chain)


@cache
def _good_content() -> str:
    return json.dumps(good_calibration().to_dict())


def use_calibration(calibration: Calibration) -> None:
    """Run the core with this calibration and with samples of every sensor."""
    core, reporter = Core(), TopicWriter(rig(), Outbox("b/bridge/state"), UnixClock())
    events: list[Event] = [Configured(BEGIN_NS, rig(), calibration, 1)]
    events += [SourceOpened(BEGIN_NS, name) for name in SENSORS]
    for number in range(12):
        t_ns = BEGIN_NS + number * PERIOD_NS
        for name in SENSORS:
            data = xbus_bytes(name, number) if name in XBUS else xcdi_bytes(name, number, t_ns)
            events.append(ChunkArrived(name, Chunk(t_ns, data)))
    for event in events:
        for output in core.feed(event):
            reporter.output(output)


def run_calibration(data: bytes) -> None:
    """Load a stored calibration; use it if it is accepted."""
    store = CalibrationStore(folder(), "fuzz")
    path = store.path(1)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    use_calibration(store.load(1))


def run_calibration_content(data: bytes) -> None:
    """Change a valid calibration as the input describes, with a valid checksum; load it."""
    content = json.loads(_good_content())
    leaves = _leaves(content)
    for number in range(0, len(data) - 1, 2):
        parent, key = leaves[data[number] % len(leaves)]
        parent[key] = VALUES[data[number + 1] % len(VALUES)]
    run_calibration(json.dumps(content).encode())


VALUES: tuple[object, ...] = (
    None, True, 0, -1, 2**63, 10**400, 0.0, 1e308, float("nan"), float("inf"), "", "x", "\ud800",
    [], [0.0] * 3, [0.0] * 4, [1.0, 0.0, 0.0, 0.0], [[]], {}, {"a": 1}, ["S1"], "thigh", 1e-300,
)  # fmt: skip
"""Values of every type that a damaged file may contain instead of the right type."""


def _leaves(node: Any) -> list[tuple[Any, Any]]:
    """Return every leaf of nested tables and lists, as its container and its key."""
    found: list[tuple[Any, Any]] = []
    if isinstance(node, dict | list):
        pairs = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in pairs:
            found.append((node, key))
            found += _leaves(value)
    return found


def seeds_calibration() -> list[bytes]:
    """Return a file as the store writes it."""
    store = CalibrationStore(folder(), "seed")
    version = store.save(good_calibration())
    return [store.path(version).read_bytes()]


# --- recordings -------------------------------------------------------------------------------


def run_recording(data: bytes) -> None:
    """Read a damaged recording, up to its first events."""
    path = folder() / "recording.mcap"
    path.write_bytes(data)
    for number, _ in enumerate(read_events(path)):
        if number > 200:
            break


def seeds_recording() -> list[bytes]:
    """Return a recording of a configuration, an opened source, a chunk and a tick."""
    events: list[Event] = [
        Configured(BEGIN_NS, parse_rig(table()), good_calibration(), 1),
        SourceOpened(BEGIN_NS, "S1"),
        ChunkArrived("S1", Chunk(BEGIN_NS, xbus_bytes("S1", 1))),
        Tick(BEGIN_NS + 1),
    ]
    with tempfile.TemporaryDirectory() as name:
        return [write_recording(Path(name), events).read_bytes()]


def run_recorded_event(data: bytes) -> None:
    """Decode the content of a recorded event."""
    kind, _, content = data.partition(b" ")
    decode_event(kind.decode("ascii", "replace"), content)


def seeds_recorded_event() -> list[bytes]:
    """Return a configuration and a closed source."""
    configured = Configured(BEGIN_NS, parse_rig(table()), good_calibration(), 1)
    closed = SourceClosed(BEGIN_NS, "S1", "lost", "unplugged")
    return [b"configured " + encode_event(configured), b"closed " + encode_event(closed)]


def run_spool(data: bytes) -> None:
    """Read a spool file, deliver its messages, and append to it."""
    place = folder() / "spool"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    (place / "00000007.spool").write_bytes(data)
    files = SpoolFiles(place, 100_000)
    files.load()
    files.append([SpooledMessage("late/pose", b"{}")])
    topics, found = [], files.oldest()
    while found is not None:
        number, messages = found
        topics += [message.topic for message in messages]
        files.remove(number)
        found = files.oldest()
    assert topics[-1] == "late/pose"
    assert not any({"#", "+", "\0"} & set(topic) for topic in topics)
    assert files.waiting == files.size_bytes == 0


def seeds_spool() -> list[bytes]:
    """Return a file of three messages, and a file with an invalid topic (a wildcard)."""
    kept, wild = folder() / "spool-seed", folder() / "spool-wild"
    for place, topics in ((kept, ("late/pose", "bridge/event", "late/pose")), (wild, ("late/#",))):
        SpoolFiles(place, 100_000).append([SpooledMessage(t, b'{"seq":1}') for t in topics])
    return [next(place.iterdir()).read_bytes() for place in (kept, wild)]


TARGETS = (
    Target("mqtt-request", run_request, seeds_request, share=3),
    Target("rig-toml", run_rig, seeds_rig, (ConfigError,), share=0.1),
    Target("calibration-file", run_calibration, seeds_calibration, (CalibrationFileError,), 0.4),
    Target(
        "calibration-content",
        run_calibration_content,
        lambda: [bytes(8)],
        (CalibrationFileError,),
        0.4,
        32,
    ),
    Target("spool", run_spool, seeds_spool, share=0.4),
    Target("recording", run_recording, seeds_recording, (RecordingError, ConfigError), share=0.4),
    Target(
        "recorded-event", run_recorded_event, seeds_recorded_event, (ValueError, ConfigError), 0.4
    ),
)
