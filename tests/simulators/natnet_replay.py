"""NatNet server that replays a capture. Invariant: frames are sent as recorded, byte for byte."""

from __future__ import annotations

import asyncio
import time

from typing_extensions import override  # typing has it from Python 3.12

from jointfit_simulators.recorded import RecordedCameras

_NS = 10**9


class NatNetReplay(RecordedCameras):
    """Server that sends the datagrams of a capture to one client, at the recorded intervals."""

    @property
    def frames(self) -> int:
        """Number of frames in the capture."""
        return len(self.chunks)

    @override
    async def run(self) -> None:
        """Answer until cancelled; send all frames after the first client has received the model."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(super().run(), name="natnet replay answers")
            while not self.ready:
                await asyncio.sleep(0.01)

            first_ns, loop = self.chunks[0][0], asyncio.get_running_loop()
            began = loop.time()
            self.begin(time.monotonic_ns() - first_ns)
            for t_ns, data in self.chunks:
                await asyncio.sleep(began + (t_ns - first_ns) / _NS - loop.time())
                self.send(data)
