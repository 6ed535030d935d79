"""Bytes with simulated arrival times for the core: two Xbus and two XCDI sensors, cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, LimbState
from jointfit_daemon.outputs.payloads._health_encoding import core_payload
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, SourceOpened, Tick
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.natnet import BodyDescription, FrameOfData, ModelDefinition, ServerInfo
from jointfit_protocols.natnet import encode as encode_natnet
from jointfit_protocols.xbus import XbusMessageId
from jointfit_protocols.xbus import encode as encode_xbus
from jointfit_protocols.xbus.mtdata2 import Item, encode_items
from jointfit_protocols.xcdi import DataId, quaternion_counts
from jointfit_protocols.xcdi import encode as encode_xcdi

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.pipeline.events import Event, Output

MS = 1_000_000
PERIOD_NS = 10 * MS
BEGIN_NS = 5_000_000_000
XBUS, XCDI = ("S1", "S3"), ("S2", "S4")
SENSORS = ("S1", "S2", "S3", "S4")
DELAYS_NS = {"S1": 2 * MS, "S2": MS, "S3": 3 * MS, "S4": 4 * MS, "mocap": 6 * MS}
IDS = {"S2": (0x205, 0x206, 0x221), "S4": (0x405, 0x406, 0x421)}
_VERSION = (3, 0)
_NOWHERE = (0.0, 0.0, 0.0)


def replay_states(events: Iterable[Event]) -> list[LimbState]:
    """Return the limb states of a new core for recorded events."""
    core = Core()
    outputs = (output for event in events for output in core.feed(event))
    return [output for output in outputs if isinstance(output, LimbState)]


def table(**head: Any) -> dict[str, Any]:
    """Return a rig.toml of five sources."""
    imus: list[dict[str, Any]] = []
    for name, segment in zip(SENSORS, ("thigh", "thigh", "shank", "shank"), strict=True):
        imu: dict[str, Any] = {"id": name, "segment": segment}
        if name in XBUS:
            imu |= {"driver": "xbus", "port": f"/dev/tty{name}", "baud": 921600}
        else:
            keys = ("sample_time", "group_counter", "quaternion")
            ids = dict(zip(keys, IDS[name], strict=True))
            imu |= {"driver": "xcdi", "can": "can0", "ids": ids, "sample_time_unit": "100us"}
        imus.append(imu)
    return {
        "rig": {"name": "r", "output_rate_hz": 100} | head,
        "chain": {"joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"]},
        "imu": imus,
        "can": {"can0": {"interface": "socketcan", "channel": "can0"}},
        "mocap": {
            "driver": "natnet",
            "server": "127.0.0.1",
            "rigid_body": {"thigh": "Thigh", "shank": "Shank"},
        },
    }


def orientation(name: str, number: int) -> tuple[float, float, float, float]:
    """Return the orientation of a sensor that swings about a fixed axis at up to 115 deg/s."""
    half = 0.5 * math.sin(0.02 * number + len(name) + ord(name[-1]))
    axis = [0.0, 0.0, 0.0]
    axis[ord(name[-1]) % 3] = math.sin(half)
    return math.cos(half), axis[0], axis[1], axis[2]


def counter(number: int) -> int:
    """Return the device's counter of sample `number`."""
    return number % 65536


def xbus_bytes(name: str, number: int) -> bytes:
    """Return sample `number` of an Xbus sensor."""
    items: list[tuple[int, Any]] = [
        (Item.PACKET_COUNTER, counter(number)),
        (Item.SAMPLE_TIME_FINE, number * 100),
        (Item.QUATERNION, orientation(name, number)),
    ]
    return encode_xbus(XbusMessageId.MT_DATA2, encode_items(items))


def xcdi_bytes(name: str, number: int, t_ns: int) -> bytes:
    """Return the three records of sample `number` of an XCDI sensor."""
    time_id, counter_id, quaternion_id = IDS[name]
    rows = (
        (time_id, DataId.SAMPLE_TIME, (number * 100,)),
        (counter_id, DataId.GROUP_COUNTER, (counter(number),)),
        (quaternion_id, DataId.QUATERNION, quaternion_counts(orientation(name, number))),
    )
    return pack_frames(
        [CanFrame(t_ns, number, encode_xcdi(kind, counts)) for number, kind, counts in rows]
    )


def camera_bytes(number: int) -> bytes:
    """Return camera frame `number`, without markers and bodies."""
    ticks = number * 100_000
    return encode_natnet(FrameOfData(number, 0.0, ticks, ticks + 1, ticks + 2), _VERSION)


def camera_hello(t_ns: int) -> list[Event]:
    """Return the first packets of a mocap server: its description and its model."""
    info = ServerInfo("Motive", (2, 1, 0, 0), (3, 0, 0, 0), 10_000_000)
    bodies = tuple(
        BodyDescription(name, number, -1, _NOWHERE, (), (), ())
        for number, name in enumerate(("Thigh", "Shank"), 1)
    )
    words = (encode_natnet(info, _VERSION), encode_natnet(ModelDefinition(bodies), _VERSION))
    return [ChunkArrived("mocap", Chunk(t_ns, word)) for word in words]


def chunk(name: str, number: int, delay_ns: int | None = None) -> ChunkArrived:
    """Return the chunk with sample `number` of a source, which arrives after `delay_ns`."""
    t_ns = BEGIN_NS + number * PERIOD_NS + (DELAYS_NS[name] if delay_ns is None else delay_ns)
    if name == "mocap":
        return ChunkArrived(name, Chunk(t_ns, camera_bytes(number)))
    data = xbus_bytes(name, number) if name in XBUS else xcdi_bytes(name, number, t_ns)
    return ChunkArrived(name, Chunk(t_ns, data))


def opening(*, mocap: bool = True) -> list[Event]:
    """Return the events before the first sample."""
    rig = parse_rig(table())
    events: list[Event] = [Configured(BEGIN_NS, rig, None)]
    events += [SourceOpened(BEGIN_NS, source.id) for source in rig.sources]
    return events + (camera_hello(BEGIN_NS) if mocap else [])


def arrival_ns(event: Event) -> int:
    """Return the host time of an event, ns."""
    return event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns


@dataclass
class Bench:
    """A core that receives all events in time, and a tick exactly at each deadline."""

    core: Core = field(default_factory=Core)
    fed: list[Event] = field(default_factory=list)
    out: list[Output] = field(default_factory=list)
    states: list[LimbState] = field(default_factory=list)
    said_ns: dict[int, int] = field(default_factory=dict)
    """Time of the output of each frame, by the time of the frame, ns."""

    def feed(self, events: Iterable[Event]) -> None:
        """Feed events in order, and between them the ticks that the core requests."""
        for event in events:
            self.wait_until(arrival_ns(event))
            self.give(event, arrival_ns(event))

    def wait_until(self, t_ns: int) -> None:
        """Feed the ticks that are due before `t_ns`."""
        while (due_ns := self.core.next_deadline_ns) is not None and due_ns < t_ns:
            self.give(Tick(due_ns), due_ns)

    def give(self, event: Event, now_ns: int) -> None:
        """Feed one event at `now_ns`, without the ticks that were due before it."""
        self.fed.append(event)
        for output in self.core.feed(event):
            self.out.append(output)
            if isinstance(output, LimbState):
                self.states.append(output)
                self.said_ns[output.t_ns] = now_ns

    def devices(self) -> dict[str, Any]:
        """Return the core's counters of every device."""
        found: dict[str, Any] = core_payload(self.core.health(arrival_ns(self.fed[-1])))["devices"]
        return found
