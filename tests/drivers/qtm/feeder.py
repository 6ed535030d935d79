"""A QTM decoder for tests, small settings, and functions that return frames."""

from __future__ import annotations

from typing import Any

from jointfit_daemon.model import Chunk, Decoded, DeviceEvent, MocapFrame
from jointfit_drivers.qtm import QtmDecoder, QtmSettings
from jointfit_protocols import qtm
from jointfit_protocols.qtm import ComponentType

NAN = float("nan")
UNTURNED = (1.0, 0, 0, 0, 1, 0, 0, 0, 1)
MISSING = ((NAN,) * 12) + (-1.0,)
HIDDEN = (NAN, NAN, NAN, NAN)


def xml(
    *,
    labels: tuple[str, ...] = ("T1", "T2", "T3"),
    bodies: tuple[str, ...] = ("Thigh", "Shank"),
    up: str = "+Z",
    stamp: str | None = "Camera time",
    origins: tuple[int, ...] = (),
) -> str:
    described = "".join(
        f"<Body><Name>{name}</Name><Enabled>{'false' if name.startswith('Off') else 'true'}"
        f"</Enabled><Data_origin>{origins[i] if origins else 0}</Data_origin></Body>"
        for i, name in enumerate(bodies)
    )
    named = "".join(f"<Label><Name>{name}</Name></Label>" for name in labels)
    enabled = str(stamp is not None).lower()
    return (
        "<QTM_Parameters_Ver_1.25><General><External_Timestamp>"
        f"<Enabled>{enabled}</Enabled><Type>{stamp}</Type></External_Timestamp></General>"
        f"<The_3D><AxisUpwards>{up}</AxisUpwards><CalibrationTime>x</CalibrationTime>{named}"
        f"</The_3D><The_6D>{described}</The_6D></QTM_Parameters_Ver_1.25>"
    )


def body(x: float, y: float, z: float, rotation: tuple[float, ...] = UNTURNED) -> tuple[float, ...]:
    return (x, y, z, *rotation, 0.5)


def markers(*items: tuple[float, ...]) -> qtm.ItemsComponent:
    return qtm.ItemsComponent(ComponentType.MARKERS_RESIDUAL, 0, 0, items)


def bodies(*items: tuple[float, ...]) -> qtm.ItemsComponent:
    return qtm.ItemsComponent(ComponentType.BODIES_RESIDUAL, 0, 0, items)


def camera_time(ticks: int) -> qtm.TimecodeComponent:
    return qtm.TimecodeComponent((qtm.QtmTimecode(2, ticks >> 32, ticks & 0xFFFFFFFF),))


THREE = markers((100.0, 200, 300, 1), HIDDEN, (1.0, 2, 3, 1))
TWO = bodies(body(100, 200, 300), MISSING)


def frame(number: int, *parts: qtm.Component, us: int | None = None) -> qtm.DataFrame:
    stamp = number * 10_000 if us is None else us
    return qtm.DataFrame(stamp, number, parts or (TWO, THREE, camera_time(stamp * 10)))


class QtmFeeder:
    """A decoder and its events."""

    def __init__(self, **settings: Any) -> None:
        table = {"driver": "qtm", "server": "x", **settings}
        self.decoder = QtmDecoder(QtmSettings.model_validate(table))
        self.events: list[Decoded] = []

    def __call__(self, *messages: qtm.Message, t_ns: int = 0) -> list[Decoded]:
        out = [
            item for message in messages
            for item in self.decoder.feed(Chunk(t_ns, qtm.encode(message)))
        ]  # fmt: skip
        self.events += out
        return out

    def frames(self, *messages: qtm.Message, t_ns: int = 0) -> list[MocapFrame]:
        return [item for item in self(*messages, t_ns=t_ns) if isinstance(item, MocapFrame)]

    def texts(self, kind: str) -> list[str]:
        return [e.text for e in self.events if isinstance(e, DeviceEvent) and e.kind == kind]


def ready(*, settings: str | None = None, **table: Any) -> QtmFeeder:
    feeder = QtmFeeder(**table)
    feeder(qtm.SettingsReply(xml() if settings is None else settings))
    return feeder
