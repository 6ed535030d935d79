"""Selection of motions by the calibration phase that a daemon publishes over MQTT.

Invariant: the module subscribes only to the topic ``calibration`` (docs/mqtt.md), and publishes
nothing.
"""

from __future__ import annotations

import asyncio
from itertools import cycle
from typing import TYPE_CHECKING

import aiomqtt
import orjson

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_simulators.scene._rig_file import RigOptions

_Motions = tuple[tuple[str, float], ...]
_FUNCTIONAL: dict[str, _Motions] = {
    "leg": (("functional", 20.0), ("walk", 9.0), ("squat", 9.0), ("sit_to_stand", 9.0)),
    "legs": (("functional", 32.0), ("walk", 10.0), ("squat", 9.0), ("sit_to_stand", 9.0)),
    "arm": (("functional", 20.0), ("elbow_flexion", 9.0), ("wrist_circles", 9.0), ("reach", 9.0)),
    "trunk": (("functional", 20.0), ("bend", 9.0), ("twist", 9.0), ("side_bend", 9.0)),
}
_CALIBRATED = {"leg": "walk", "legs": "walk", "arm": "reach", "trunk": "bend"}
MOTIONS_OF_PHASES: dict[str, dict[str, _Motions]] = {
    limb: {
        "align": (("plate", 20.0),),
        "static": (("stand", 5.0),),
        "functional": motions,
        "calibrated": ((_CALIBRATED[limb], 20.0),),
    }
    for limb, motions in _FUNCTIONAL.items()
}
"""Motions of each phase with their durations, s, by limb; a phase repeats its motions.

In other phases, the subject stands."""
_OTHER_PHASES = (("stand", 5.0),)
_RETRY_S = 1.0
"""Time before the next attempt to connect to the broker, s."""


class PhaseFollower:
    """Starts the motions of the calibration phase that a daemon publishes.

    Parameters
    ----------
    rig
        Broker address and base topic.
    play
        Callback that receives the name of the motion to start.
    report
        Callback that receives a message when the broker connection is lost or restored.
    limb
        ``leg``, ``legs``, ``arm`` or ``trunk``.
    """

    def __init__(
        self,
        rig: RigOptions,
        play: Callable[[str], None],
        report: Callable[[str], None],
        limb: str = "leg",
    ) -> None:
        self._rig, self._play, self._report = rig, play, report
        self._motions_of_phases = MOTIONS_OF_PHASES[limb]
        self._phase: str | None = None
        self._motions: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Run until cancelled; retry the broker connection every second."""
        rig = self._rig
        broker = f"{rig.mqtt_host}:{rig.mqtt_port}"
        topic = f"{rig.mqtt_base}/calibration"
        version = aiomqtt.ProtocolVersion
        protocol = version.V5 if rig.mqtt_version == "5" else version.V311
        reported = ""
        try:
            while True:
                try:
                    async with aiomqtt.Client(
                        rig.mqtt_host, rig.mqtt_port, protocol=protocol
                    ) as client:
                        await client.subscribe(topic, qos=1)
                        reported = f"follows {topic} on broker {broker}"
                        self._report(reported)
                        async for message in client.messages:
                            self._receive(message.payload)
                except aiomqtt.MqttError:
                    lost = (
                        f"no broker at {broker}: start one there, or set --mqtt-host and"
                        " --mqtt-port"
                    )
                    if lost != reported:  # report once, not every second
                        reported = lost
                        self._report(lost)
                await asyncio.sleep(_RETRY_S)
        finally:
            if self._motions is not None:
                self._motions.cancel()

    def _receive(self, payload: object) -> None:
        """Start the motions of a new phase; ignore a repeated status."""
        try:
            status = orjson.loads(payload) if isinstance(payload, bytes | bytearray) else None
        except orjson.JSONDecodeError:
            return
        phase = status.get("phase") if isinstance(status, dict) else None
        if not isinstance(phase, str) or phase == self._phase:
            return

        self._phase = phase
        if self._motions is not None:
            self._motions.cancel()
        motions = self._motions_of_phases.get(phase, _OTHER_PHASES)
        self._play(motions[0][0])
        self._motions = asyncio.create_task(
            self._play_in_turn(motions), name="motions of the phase"
        )

    async def _play_in_turn(self, motions: tuple[tuple[str, float], ...]) -> None:
        """Repeat the motions in a cycle; the first motion already plays."""
        if len(motions) == 1:
            return
        for at, (name, seconds) in enumerate(cycle(motions)):
            if at:
                self._play(name)
            await asyncio.sleep(seconds)
