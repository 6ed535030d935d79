"""An independent C++ client of motion-capture servers, in a child process.

The client blocks in its library, so the process is killed at the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import signal
import sys
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

CLIENT = """
import json, sys, motioncapture
mc = motioncapture.connect(sys.argv[1], json.loads(sys.argv[2]))
while True:
    mc.waitForNextFrame()
    bodies = {n: [*map(float, b.position), b.rotation.w, b.rotation.x, b.rotation.y, b.rotation.z]
              for n, b in mc.rigidBodies.items()}
    print(json.dumps(bodies), flush=True)
"""

needs_client = pytest.mark.skipif(
    importlib.util.find_spec("motioncapture") is None,
    reason="motioncapture has no wheel for this platform",
)


@contextlib.asynccontextmanager
async def oracle_frames(back_end: str, **settings: str) -> AsyncIterator[Any]:
    """Run the client; yield a function that returns the bodies of its next frame."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", CLIENT, back_end, json.dumps(settings),
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    assert process.stdout is not None
    lines = process.stdout

    async def next_frame() -> dict[str, list[float]]:
        async with asyncio.timeout(20):
            while True:
                line = await lines.readline()
                assert line, "the client ended"
                if line.startswith(b"{"):
                    return dict(json.loads(line))

    try:
        yield next_frame
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        await process.wait()
        # The transport of the pipe would otherwise outlive the test.
        process._transport.close()  # type: ignore[attr-defined]
