"""Publication of a replay with the topics and payloads of the daemon, below another base topic.

The payloads contain the time stamps of the recording. The topic ``bridge/health`` describes a
running daemon, so it is not published. Invariant: requests to a replay are ignored, and all
messages are below the base topic of the replay.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from pydantic import ValidationError
from typing_extensions import override  # typing contains it from Python 3.12

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt import BrokerLostError, MqttPublisher, Outbox
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import Configured, UnixOffset

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.config import Rig
    from jointfit_daemon.pipeline.events import Event, Output

PREFIX = "replay/"
"""Prefix of the base topic. It prevents subscribers from confusing a replay with the daemon."""
CONNECT_S = 5.0
"""Longest wait for the broker, s."""
_DRAIN_S = 5.0
"""Longest wait for the broker to accept the last messages, s."""
_FULL, _POLL_S = 100, 0.002
"""Number of queued messages at which the replay waits for the broker, and the interval between
checks, s."""


class RecordedClock(UnixClock):
    """Clock that returns the UNIX time and the host time of the current recorded event."""

    def __init__(self) -> None:
        super().__init__()
        self.played_ns = 0
        """Time of the current event, CLOCK_MONOTONIC of the recorded host, ns."""
        self.recorded_offset_ns = 0
        """UNIX time minus CLOCK_MONOTONIC of the recorded host, ns."""

    @override
    def offset_ns(self) -> int:
        return self.recorded_offset_ns

    @override
    def now_ns(self) -> int:
        return self.played_ns


class Publication:
    """A connection to a broker that publishes one replay.

    Parameters
    ----------
    rig
        First recorded rig, with names, rates and broker.
    base
        Base topic; the default is `PREFIX` followed by the base topic of the rig.
    broker
        ``HOST`` or ``HOST:PORT``; the default is the broker of the rig.

    Raises
    ------
    ValueError
        The base topic or the broker is invalid.
    """

    def __init__(self, rig: Rig, base: str | None, broker: str | None) -> None:
        self._base, self._broker = base, broker
        self._clock = RecordedClock()
        rig = self._redirect_rig(rig)
        self._settings = rig.mqtt
        # The clock is constant, so no message expires. Instead, the replay waits for the broker.
        self._outbox = Outbox(topics.BRIDGE_STATE.name(rig.mqtt.base), clock=lambda: 0.0)
        self._link = MqttPublisher(rig.mqtt, self._outbox, lambda _: None)
        self._topics = TopicWriter(rig, self._outbox, self._clock)
        self._task: asyncio.Task[None] | None = None

    @property
    def base(self) -> str:
        """Base topic of the replay."""
        return self._settings.base

    @property
    def dropped(self) -> int:
        """Number of messages that the broker did not accept."""
        return self._outbox.dropped + self._outbox.queued

    def _redirect_rig(self, rig: Rig) -> Rig:
        """Return `rig` with the broker and the base topic of the replay."""
        changed: dict[str, object] = {"base": self._base or PREFIX + rig.mqtt.base}
        changed["home_assistant"] = None  # a discovery message would announce another device
        if self._broker is not None:
            host, _, port = self._broker.partition(":")
            changed |= {"host": host, "port": port or 0}
        try:
            settings = MqttSettings.model_validate({**rig.mqtt.model_dump(), **changed})
        except ValidationError as error:
            faults = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            raise ValueError(f"--base or --broker: {'; '.join(faults)}") from error
        return replace(rig, mqtt=settings)

    async def start(self) -> None:
        """Connect to the broker.

        Raises
        ------
        BrokerLostError
            The broker does not accept a connection within `CONNECT_S`.
        """
        self._task = asyncio.create_task(self._link.run(), name="mqtt")
        loop = asyncio.get_running_loop()
        until = loop.time() + CONNECT_S
        while not self._link.connected:
            if loop.time() > until:
                raise BrokerLostError(
                    f"broker {self._settings.host}:{self._settings.tcp_port}: no connection within "
                    f"{CONNECT_S:g} s: start this broker, or name another broker with --broker"
                )
            await asyncio.sleep(_POLL_S)

    async def publish(self, t_ns: int, event: Event, outputs: Iterable[Output]) -> None:
        """Publish the outputs of an event; wait while the broker is slower than the replay."""
        self._clock.played_ns = t_ns
        if isinstance(event, UnixOffset):
            self._clock.recorded_offset_ns = event.offset_ns
        elif isinstance(event, Configured):
            self._topics.configure(self._redirect_rig(event.rig))
        for output in outputs:
            self._topics.output(output)
        while self._outbox.queued > _FULL:  # noqa: ASYNC110 - the outbox has no event for it
            await asyncio.sleep(_POLL_S)

    async def stop(self) -> None:
        """Send the last messages, remove the retained messages, and disconnect."""
        await self._link.flush(_DRAIN_S, streams=True)
        for topic in self._outbox.retained:
            if topic != self._outbox.state_topic:
                self._outbox.retain(topic, b"")
        await self._link.flush(_DRAIN_S)
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])
