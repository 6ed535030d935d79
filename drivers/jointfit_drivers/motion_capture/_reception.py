"""Reception of frames for a diagnosis, and findings about their content."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.device_search import Finding
from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent, MocapFrame

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence
    from typing import Any

    from jointfit_daemon.driver import Decoder, Emit, MocapSettings
    from jointfit_daemon.model import Chunk

    Connect = Callable[[Emit], Coroutine[Any, Any, None]]

CHECK = "mocap"
"""Subject of all findings in this module."""
FRAMES_S = 1.0
"""Duration of the reception after the first frame, s."""


async def run_until(
    connection: Coroutine[Any, Any, None],
    arrived: asyncio.Event,
    limit_s: float,
    *,
    further_s: float = 0.0,
) -> DeviceLostError | DeviceMisconfiguredError | None:
    """Run a connection for a limited time; return the device error that ended it, if any.

    Parameters
    ----------
    connection : coroutine
        Connection to run. It is cancelled at the end.
    arrived : asyncio.Event
        Event that is set when the expected data have arrived.
    limit_s : float
        Longest wait for the expected data, s.
    further_s : float
        Duration of the connection after the arrival of the expected data, s.
    """
    running = asyncio.create_task(connection, name="connection")
    waiting = asyncio.create_task(arrived.wait(), name="expected data")
    try:
        await asyncio.wait({running, waiting}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if arrived.is_set():
            await asyncio.sleep(further_s)
    finally:
        running.cancel()
        waiting.cancel()
        await asyncio.wait({running, waiting})

    error = None if running.cancelled() else running.exception()
    if error is None or isinstance(error, DeviceLostError | DeviceMisconfiguredError):
        return error
    raise error


class Reception:
    """Receives and decodes everything that a server sends.

    Parameters
    ----------
    decoder : Decoder
        A new decoder.
    connect : callable
        Function that connects in the same way as the driver, and passes every chunk to its
        argument.
    """

    def __init__(self, decoder: Decoder, connect: Connect) -> None:
        self._decoder = decoder
        self._connect = connect
        self.events: list[DeviceEvent] = []
        self.frames: list[MocapFrame] = []
        self.failure: DeviceLostError | DeviceMisconfiguredError | None = None
        """Error that ended the connection; None if no error occurred."""

    @property
    def warnings(self) -> list[str]:
        """Warnings of the decoder, without repetitions."""
        texts = [event.text for event in self.events if event.kind in ("warning", "error")]
        return list(dict.fromkeys(texts))

    @property
    def facts(self) -> dict[str, object]:
        """Data of all events of the kind ``info``. They describe the server."""
        found: dict[str, object] = {}
        for event in self.events:
            found |= event.data if event.kind == "info" else {}
        return found

    async def receive(self, limit_s: float) -> None:
        """Wait for the first frame, at most `limit_s` seconds, and then receive for `FRAMES_S`."""
        arrived = asyncio.Event()

        def take(chunk: Chunk) -> None:
            for item in self._decoder.feed(chunk):
                if isinstance(item, MocapFrame):
                    self.frames.append(item)
                    arrived.set()
                elif isinstance(item, DeviceEvent):
                    self.events.append(item)

        self.failure = await run_until(self._connect(take), arrived, limit_s, further_s=FRAMES_S)


def content_findings(
    settings: MocapSettings, reception: Reception, name: str, remedy: str
) -> list[Finding]:
    """Return the findings about the content of a stream of frames.

    Parameters
    ----------
    settings : MocapSettings
        The ``[mocap]`` table.
    reception : Reception
        Reception with at least one frame.
    name : str
        Name of the server.
    remedy : str
        Instruction for selecting the streamed markers and bodies in the camera software.
    """
    frames = reception.frames
    layout = frames[-1].layout
    findings = [
        Finding(CHECK, name, "warning", text, "correct [mocap], or the camera software")
        for text in reception.warnings
    ]
    if not layout.bodies and not layout.markers:
        text = "the stream has no rigid body and no labeled marker"
        findings.append(Finding(CHECK, name, "error", text, remedy))
    if not frames[-1].live:
        text = "the frames come from a recording, not from the cameras"
        findings.append(Finding(CHECK, name, "warning", text, "switch to live measurement"))

    findings += tracking_findings(settings, frames, name, "check its definition")
    return findings or [summary(frames, name)]


def tracking_findings(
    settings: MocapSettings, frames: Sequence[MocapFrame], name: str, remedy: str
) -> list[Finding]:
    """Return a finding for each streamed rigid body of rig.toml that was tracked in no frame.

    Parameters
    ----------
    settings : MocapSettings
        The ``[mocap]`` table.
    frames : sequence of MocapFrame
        Received frames, at least one.
    name : str
        Name of the server.
    remedy : str
        Instruction for checking the definition of a body in the camera software.
    """
    findings = []
    bodies = frames[-1].layout.bodies
    for segment, body in settings.rigid_body.items():
        if body in bodies:
            column = bodies.index(body)
            if all(np.isnan(frame.body_positions[column]).any() for frame in frames):
                text = f"rigid body {body!r} of {segment} was not tracked in {len(frames)} frames"
                view = f"put the body in view of the cameras, and {remedy}"
                findings.append(Finding(CHECK, name, "warning", text, view))
    return findings


def summary(frames: Sequence[MocapFrame], name: str) -> Finding:
    """Return the finding for a stream without faults: rate and content of the frames."""
    layout, span_s = frames[-1].layout, (frames[-1].arrival_ns - frames[0].arrival_ns) / 1e9
    rate = f"{(len(frames) - 1) / span_s:.0f} frames a second, " if span_s > 0 else ""
    content = f"{rate}{len(layout.bodies)} rigid bodies, {len(layout.markers)} markers"
    return Finding(CHECK, name, "ok", content)
