"""Connection of the monitor to its broker, which finds a rig, subscribes, and sends requests."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from jointfit_daemon.outputs.mqtt import (
    BrokerLostError,
    MqttClient,
    NoAnswerError,
    find_rigs,
)
from jointfit_daemon.tools.monitor._rig_view import TOPICS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.tools.monitor._monitor_state import MonitorState
    from jointfit_daemon.tools.monitor._rig_view import Moment

RECONNECT_S = 1.0
"""Time before the next attempt to connect, s."""
SEARCH_S = 1.2
"""Time to wait for the retained messages that describe rigs, s."""


class BrokerLink:
    """Passes the messages of a rig to a `MonitorState` until the task is cancelled.

    Parameters
    ----------
    settings
        Address and account of the broker. If `base` is empty, the link searches for a rig.
    state
        State that messages, connections and disconnections change.
    now
        Function that returns the current time.
    """

    def __init__(
        self, settings: MqttSettings, state: MonitorState, now: Callable[[], Moment]
    ) -> None:
        self._settings, self._state, self._now = settings, state, now
        self._chosen = asyncio.Event()
        self._client: MqttClient | None = None

    def choose(self, base: str) -> None:
        """Show the rig with this base topic."""
        self._settings = self._settings.model_copy(update={"base": base})
        self._state.begin_rig(base)
        self._chosen.set()

    async def run(self) -> None:
        """Connect, and reconnect after each loss of the connection."""
        if self._settings.base:
            self.choose(self._settings.base)
        while True:
            try:
                if self._chosen.is_set():
                    await self._follow()
                elif only := self._state.set_found_rigs(await find_rigs(self._settings, SEARCH_S)):
                    self.choose(only)
            except BrokerLostError as lost:
                self._state.set_lost(str(lost))
                await asyncio.sleep(RECONNECT_S)

    async def request(self, command: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request; return its answer.

        Raises
        ------
        NoAnswerError
            There is no connection, or no answer arrives in time.
        """
        if self._client is None:
            raise NoAnswerError("the monitor is not connected to the broker")
        try:
            return await self._client.request(command, arguments)
        except BrokerLostError as lost:
            raise NoAnswerError(str(lost)) from lost

    async def _follow(self) -> None:
        """Process the messages of the rig until the connection is lost."""
        try:
            async with MqttClient(self._settings) as client:
                self._client = client
                self._state.set_connected()
                await client.subscribe(*TOPICS)
                async for topic, payload in client.messages():
                    self._state.rig.take(topic, payload, self._now())
        finally:
            self._client = None
