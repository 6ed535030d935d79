"""Diagnosis of "connected, but no data" for QTM.

| cause | evidence |
|---|---|
| QTM is not running, or wrong port | the connection is refused, or the answer is not from QTM |
| no measurement | QTM answers "no more data", or has no parameters |
| firewall | frames arrive by TCP, but not by UDP |
| 6DOF or labels not calculated | frames lack the component, and the settings show the reason |
| names | the settings do not contain names of rig.toml |
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding
from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_drivers.motion_capture import CHECK, Reception, content_findings, find_route
from jointfit_drivers.qtm._decoder import QtmDecoder
from jointfit_drivers.qtm._session import ANSWER_S, QtmSession

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.qtm._settings import QtmSettings

_STREAM = "in QTM: Project Options, Processing, Real-time actions: 3D tracking, AIM, Calculate 6DOF"
_START = "in QTM start a measurement or the preview (New), or RT from file"


async def diagnose(settings: QtmSettings, wait_s: float) -> list[Finding]:
    """Return the findings for a ``[mocap]`` table; see `Diagnosis.diagnose`."""
    name = settings.server
    patient = settings.model_copy(update={"silence_s": wait_s})
    reception = await _receive(patient, wait_s)
    if reception.frames:
        return content_findings(settings, reception, name, _STREAM)

    failure = reception.failure
    if any(event.data.get("waiting") for event in reception.events):
        text = "QTM answers, but no measurement is running"
        return [Finding(CHECK, name, "error", text, _START)]
    if "protocol" not in reception.facts or isinstance(failure, DeviceMisconfiguredError):
        text = "no answer" if failure is None else str(failure)
        remedy = f"set server and command_port in [mocap]; ping {name}"
        return [Finding(CHECK, name, "error", text, remedy)]

    # QTM answers but sends no frames. A firewall may drop the datagrams.
    if settings.transport == "udp":
        over_tcp = await _receive(patient.model_copy(update={"transport": "tcp"}), wait_s)
        if over_tcp.frames:
            text = "frames arrive by TCP, but not by UDP: a firewall drops the datagrams"
            port = settings.data_port or "PORT"
            remedy = (
                f'set transport = "tcp" in [mocap]; or set data_port, and sudo ufw allow {port}/udp'
            )
            return [Finding(CHECK, name, "error", text, remedy)]
    text = "QTM answers, but sends no frame" if failure is None else str(failure)
    return [Finding(CHECK, name, "error", text, _START)]


async def _receive(settings: QtmSettings, wait_s: float) -> Reception:
    """Receive frames in the same way as the driver, and return the reception."""

    async def connect(emit: Emit) -> None:
        route = await find_route("QTM", settings)
        await QtmSession(settings, route, emit).run()

    reception = Reception(QtmDecoder(settings), connect)
    await reception.receive(2 * ANSWER_S + wait_s)
    return reception
