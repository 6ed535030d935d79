"""A NatNet decoder for tests, a small model, and functions that return its frames."""

from __future__ import annotations

from typing import Any

from jointfit_daemon.model import (
    Chunk,
    Decoded,
    DeviceEvent,
    MocapFrame,
)
from jointfit_drivers.natnet import NatNetDecoder, NatNetSettings
from jointfit_protocols.natnet import (
    Body,
    BodyDescription,
    FrameOfData,
    LabeledMarker,
    MarkerSetDescription,
    Message,
    ModelDefinition,
    ServerInfo,
    encode,
)

INFO = ServerInfo("Motive", (2, 1, 0, 0), (3, 0, 0, 0), 10_000_000)
NO_OFFSET = (0.0, 0.0, 0.0)


def described(name: str, number: int, *markers: str, named: bool = False) -> BodyDescription:
    n = len(markers)
    return BodyDescription(
        name, number, -1, NO_OFFSET, (NO_OFFSET,) * n, (0,) * n, markers if named else ()
    )


THIGH = described("Thigh", 1, "T1", "T2", "T3")
SHANK = described("Shank", 2, "S1", "S2")
MODEL = ModelDefinition(
    (
        THIGH,
        SHANK,
        MarkerSetDescription("Thigh", ("T1", "T2", "T3")),
        MarkerSetDescription("Shank", ("S1", "S2")),
    )
)


def marker(number: int, at: tuple[float, float, float], params: int = 10) -> LabeledMarker:
    return LabeledMarker(number, *at, 0.5, params, 0.0)


def body(number: int, q: tuple[float, float, float, float], params: int = 1) -> Body:
    return Body(number, 1.0, 2.0, 3.0, *q, 0.0, params)


def frame(number: int, **parts: Any) -> FrameOfData:
    ticks = parts.pop("ticks", number * 1000)
    return FrameOfData(number, 0.0, parts.pop("exposure", ticks), ticks + 1, ticks + 2, **parts)


class Feeder:
    """A decoder and its output."""

    def __init__(
        self, *, up_axis: str = "z", version: tuple[int, int] = (3, 0), **settings: Any
    ) -> None:
        table = {"driver": "natnet", "server": "x", "up_axis": up_axis, **settings}
        self.decoder = NatNetDecoder(NatNetSettings.model_validate(table))
        self.version = version
        self.events: list[Decoded] = []

    def __call__(self, *messages: Message, t_ns: int = 0) -> list[Decoded]:
        out = [
            event
            for message in messages
            for event in self.decoder.feed(Chunk(t_ns, encode(message, self.version)))
        ]
        self.events += out
        return out

    def frame(self, *messages: Message) -> MocapFrame:
        (found,) = [event for event in self(*messages) if isinstance(event, MocapFrame)]
        return found


def told(events: list[Decoded], kind: str) -> list[DeviceEvent]:
    return [event for event in events if isinstance(event, DeviceEvent) and event.kind == kind]


def ready(**settings: Any) -> Feeder:
    feeder = Feeder(**settings)
    feeder(INFO, MODEL)
    return feeder
