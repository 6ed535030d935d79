"""Simulated run as events of the core: five clocks, a walk with rigid markers, two incidents.

Invariant: the run is deterministic and uses no processes, ports or waits. Ground truth accompanies
the events.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects.simulated_wearer import bench_rig
from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened
from jointfit_daemon.units import NS_PER_S
from jointfit_protocols import xbus, xcdi
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.natnet import EchoRequest, EchoResponse, ServerInfo, encode
from jointfit_protocols.xbus import mtdata2
from jointfit_simulators.body import CLUSTERS, SENSORS, SimulatedSubject, Step
from jointfit_simulators.devices import (
    CameraFrames,
    Cameras,
    FrameStamps,
    NatNetFrameBuilder,
    OrientationSensor,
    RigidBodyAsset,
    SampleTiming,
    model_definition,
)
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import Quaternion
    from jointfit_daemon.pipeline.events import Event
    from jointfit_simulators.devices import PlannedSamples

BEGIN_NS = 5_000 * NS_PER_S
TICK_NS = 100_000
SERVER_HZ = 10_000_000
VERSION = (3, 1)
PATH_NS = 400_000
"""Minimum transit time of a datagram, ns."""
BAUD = 115_200
"""Speed of the serial lines in the configuration of `bench_rig`, bit/s."""
ON_UART = ("S1", "S3")
REBOOTED, INTERRUPTED = "S3", "S2"
DOWN_NS = 1_500_000_000


@dataclass(frozen=True)
class SimulatedRun:
    """Events and ground truth of one run, the input of a plot."""

    events: Sequence[Event]
    taken_ns: Mapping[tuple[str, int], int] = field(default_factory=dict)
    """True sampling time, ns, by source and device ticks of the sample."""
    unseen_ns: Mapping[str, int] = field(default_factory=dict)
    """Minimum delay of each transport, ns, which no clock can estimate. A transport with echoes has
    no entry."""
    lag_ns: Mapping[str, int] = field(default_factory=dict)
    """Remaining lag between a sensor and the cameras, ns, by sensor."""
    incidents: Mapping[str, float] = field(default_factory=dict)
    """Times of the incidents after the start of the run, s, by name."""
    title: str = ""


@dataclass
class _Made:
    """Events and ground truth during the generation of the run."""

    chunks: list[tuple[int, str, bytes]] = field(default_factory=list)
    taken_ns: dict[tuple[str, int], int] = field(default_factory=dict)


def simulated(seconds: float = 90.0, seed: int = 1) -> SimulatedRun:
    """Return a run of four IMUs and a camera system, each with its own clock."""
    knobs = Knobs(
        seed=seed,
        clock_skew_ppm=50.0,
        occlusion=0.0,
        soft_tissue_common_deg=0.0,
        soft_tissue_sensor_deg=0.0,
        marker_soft_tissue_mm=0.0,
        orientation_white_deg=0.05,
    )
    wearer = SimulatedSubject(knobs, [Step("walk", seconds)])
    cameras = Cameras(knobs, wearer, rate_hz=knobs.mocap_hz)
    tickers = {
        name: SampleTiming(knobs, name, latency_ms=_latency_ms(knobs, name), now_ns=BEGIN_NS)
        for name in (*SENSORS, "mocap")
    }
    end_ns = BEGIN_NS + round(seconds * NS_PER_S)
    reboot_ns, gap_ns = (
        BEGIN_NS + round(0.45 * seconds * NS_PER_S),
        BEGIN_NS + round(0.7 * seconds * NS_PER_S),
    )
    taken = {name: _all(tickers[name], name, end_ns, reboot_ns, knobs) for name in tickers}
    seen = wearer.observe(
        [_seconds(taken[name][0]) for name in SENSORS],
        _seconds(taken["mocap"][0]),
        np.zeros(1),
    )
    made = _Made()
    for name, q in zip(SENSORS, seen.sensors, strict=True):
        said = OrientationSensor(knobs, name).report(_seconds(taken[name][0]), q)
        hush = (gap_ns, gap_ns + NS_PER_S // 2) if name == INTERRUPTED else (0, 0)
        _sensor(made, name, taken[name], said.tolist(), hush)
    _cameras(made, cameras, taken["mocap"], cameras.capture(seen))
    _echoes(made, tickers["mocap"], end_ns, knobs)
    rig = _rig()
    events: list[Event] = [Configured(BEGIN_NS, rig, None)]
    events += [SourceOpened(BEGIN_NS, source.id) for source in rig.sources]
    events += [ChunkArrived(name, Chunk(t, data)) for t, name, data in sorted(made.chunks)]
    unseen_ns = {name: round(_latency_ms(knobs, name) * 1e6) for name in SENSORS}
    return SimulatedRun(
        events,
        made.taken_ns,
        unseen_ns,
        # Devices truncate their stamps to whole ticks, so the stamps are half a tick early on
        # average.
        {name: unseen - TICK_NS // 2 for name, unseen in unseen_ns.items()},
        {f"{REBOOTED} reboots": 0.45 * seconds, f"{INTERRUPTED} silent": 0.7 * seconds},
        f"simulated, {seconds:g} s, a walk, clocks within ±50 ppm",
    )


def _rig() -> Rig:
    """Return a rig whose segments are rigid bodies of the cameras."""
    table = bench_rig().table
    bodies = {part: part.capitalize() for part in set(SENSORS.values())}
    mocap = {key: value for key, value in table["mocap"].items() if key != "markers"}
    return parse_rig({**table, "mocap": {**mocap, "rigid_body": bodies}})


Track = tuple["NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.bool_]"]
"""True sampling times, device stamps, transmission times, and whether each sample is lost."""


def _latency_ms(knobs: Knobs, name: str) -> float:
    if name == "mocap":
        return knobs.latency_mocap_ms
    return knobs.latency_uart_ms if name in ON_UART else knobs.latency_can_ms


def _seconds(t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return (t_ns - BEGIN_NS) / NS_PER_S


def _all(ticker: SampleTiming, name: str, end_ns: int, reboot_ns: int, knobs: Knobs) -> Track:
    period_ns = NS_PER_S / (knobs.mocap_hz if name == "mocap" else knobs.rate_hz)
    if name != REBOOTED:
        return _track([ticker.samples(BEGIN_NS, end_ns, period_ns)])
    before = ticker.samples(BEGIN_NS, reboot_ns, period_ns)
    ticker.reboot(reboot_ns + DOWN_NS)
    return _track([before, ticker.samples(reboot_ns + DOWN_NS, end_ns, period_ns)])


def _track(blocks: Sequence[PlannedSamples]) -> Track:
    return (
        np.concatenate([block.host_ns for block in blocks]),
        np.concatenate([block.device_ns for block in blocks]),
        np.concatenate([block.due_ns for block in blocks]),
        np.concatenate([block.dropped for block in blocks]),
    )


def _rows(track: Track) -> Iterator[tuple[int, int, int, bool]]:
    return zip(*(column.tolist() for column in track), strict=True)


# --- sensors ----------------------------------------------------------------------------------


def _sensor(
    made: _Made,
    name: str,
    track: Track,
    orientations: Sequence[Quaternion],
    hush: tuple[int, int],
) -> None:
    write: Callable[[str, int, int, int, Quaternion], tuple[int, bytes]]
    write = xbus_chunk if name in ON_UART else xcdi_chunk
    for number, ((host, device, due, dropped), q) in enumerate(
        zip(_rows(track), orientations, strict=True)
    ):
        ticks = max(0, device // TICK_NS)  # after a boot, jitter must not yield a negative value
        if dropped or hush[0] <= host < hush[1]:
            continue
        made.taken_ns[name, ticks] = host
        t_ns, data = write(name, number, ticks, due, q)
        made.chunks.append((t_ns, name, data))


def xbus_chunk(
    _name: str, number: int, ticks: int, due_ns: int, q: Quaternion
) -> tuple[int, bytes]:
    data = xbus.encode(
        xbus.XbusMessageId.MT_DATA2,
        mtdata2.encode_items(
            [
                (mtdata2.Item.PACKET_COUNTER, number & 0xFFFF),
                (mtdata2.Item.SAMPLE_TIME_FINE, ticks),
                (mtdata2.real_id(mtdata2.Item.QUATERNION), q),
            ]
        ),
    )
    # The chunk arrives with its last byte.
    return due_ns + len(data) * 10 * NS_PER_S // BAUD, data


def xcdi_chunk(name: str, number: int, ticks: int, due_ns: int, q: Quaternion) -> tuple[int, bytes]:
    block = (list(SENSORS).index(name) + 1) << 8
    rows = (
        (block + 5, xcdi.DataId.SAMPLE_TIME, (ticks,)),
        (block + 6, xcdi.DataId.GROUP_COUNTER, (number & 0xFFFF,)),
        (block + 33, xcdi.DataId.QUATERNION, xcdi.quaternion_counts(q)),
    )
    frames = [CanFrame(due_ns, number, xcdi.encode(kind, counts)) for number, kind, counts in rows]
    return due_ns, pack_frames(frames)


# --- cameras ----------------------------------------------------------------------------------


def _cameras(made: _Made, cameras: Cameras, track: Track, frames: CameraFrames) -> None:
    bodies = tuple(
        RigidBodyAsset(part.capitalize(), names, number)
        for number, (part, names) in enumerate(CLUSTERS.items(), 1)
    )
    info = ServerInfo("Motive", (2, 3, 0, 0), (*VERSION, 0, 0), SERVER_HZ)
    for word in (info, model_definition(bodies, VERSION)):
        made.chunks.append((BEGIN_NS, "mocap", encode(word, VERSION)))
    stage = NatNetFrameBuilder(bodies, "y", "missing")
    places = frames.body_positions.tolist()
    turns = frames.body_orientations.tolist()
    for number, (host, device, due, dropped) in enumerate(_rows(track)):
        if dropped:
            continue
        exposure = device * SERVER_HZ // NS_PER_S
        stamps = FrameStamps(
            number, device / NS_PER_S, exposure, exposure + 40_000, exposure + 50_000, 0
        )
        poses = {
            name: (tuple(at), tuple(q))
            for name, at, q in zip(cameras.bodies, places[number], turns[number], strict=True)
        }
        made.taken_ns["mocap", exposure] = host
        data = encode(stage.frame(stamps, {}, poses), VERSION)
        made.chunks.append((due, "mocap", data))


def _echoes(made: _Made, ticker: SampleTiming, end_ns: int, knobs: Knobs) -> None:
    dice = knobs.random("echoes")
    at_ns, stamp = BEGIN_NS + NS_PER_S // 10, 0
    while at_ns < end_ns:
        stamp += 1
        there, back = (PATH_NS + round(dice.exponential(100_000)) for _ in range(2))
        ticks = ticker.device_ns(at_ns + there) * SERVER_HZ // NS_PER_S
        made.chunks.append((at_ns, "mocap", encode(EchoRequest(stamp), VERSION)))
        answer = encode(EchoResponse(stamp, ticks), VERSION)
        made.chunks.append((at_ns + there + back, "mocap", answer))
        at_ns += NS_PER_S // 20 if stamp < 10 else round(dice.uniform(0.8, 1.2) * NS_PER_S)
