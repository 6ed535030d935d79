"""A simulated QTM server that answers and sends frames."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from jointfit_simulators.devices import QtmServer, QtmServerOptions, RigidBodyAsset
from tests.drivers.motion_capture.mocap_run import answering

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)
SHANK = RigidBodyAsset("Shank", ("S1",), 2)
POSE = ((1.0, 2.0, 3.0), (0.8, 0.0, 0.0, 0.6))
SEEN: dict[str, Any] = {"T1": (0.1, 0.2, 0.3), "T3": (1.0, -2.0, 0.5), "loose": (9.0, 9.0, 9.0)}


def made(**options: Any) -> QtmServer:
    return QtmServer(QtmServerOptions(**({"bodies": (THIGH, SHANK)} | options)))


def served(
    server: QtmServer, *, sends: bool = True, before: Callable[[], None] = lambda: None
) -> AbstractAsyncContextManager[None]:
    """Run a server that answers, and sends a frame every 10 ms."""

    def push() -> None:
        before()
        server.push(time.monotonic_ns(), SEEN, {"Thigh": POSE, "Shank": None})

    return answering(server, push if sends else None)
