"""`jointfit demo --web` first prints the URL, with a QR code if other devices can open the page.

Later, the demo repeats calibration phases that were aborted because the computer was busy.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import urllib.request
from typing import TYPE_CHECKING, cast

import pytest

from bench.rigs.gateway import cpu_s
from jointfit_daemon.tools.calibrate import PhaseAbortedError, PhaseTracker
from jointfit_daemon.tools.dashboard.addresses import ListenAddress
from jointfit_daemon.tools.demo._web import print_address, run_phase
from tests.system.station import PATIENCE_S, restore_signals

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.outputs.mqtt import MqttClient

URL = "http://192.0.2.7:8080/"


def test_a_url_for_other_devices_has_a_qr_code(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("segno", reason="segno is not installed (pip install jointfitd[demo])")
    print_address(URL, ListenAddress("0.0.0.0", 8080))
    first, *code = capsys.readouterr().out.splitlines()
    assert URL in first
    assert sum("▄" in line for line in code) > 10


def test_a_url_for_this_machine_names_the_option_for_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_address("http://127.0.0.1:8080/", ListenAddress("127.0.0.1", 8080))
    assert "--listen 0.0.0.0:8080" in capsys.readouterr().out


@pytest.mark.system
@pytest.mark.experiment
async def test_the_page_answers_before_the_hardware_starts_and_ctrl_c_ends_with_0(
    tmp_path: Path,
) -> None:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "demo", "--web",
        "--listen", "127.0.0.1:0", "--keep", str(tmp_path),
        stdout=asyncio.subprocess.PIPE, preexec_fn=restore_signals,
    )  # fmt: skip
    assert process.stdout is not None
    async with asyncio.timeout(PATIENCE_S):
        url = (await process.stdout.readline()).decode().split()[1]
        # The CPU time does not depend on the load of the machine, unlike the time until the URL.
        assert cpu_s(process.pid) < 1.0
        page = await asyncio.to_thread(lambda: urllib.request.urlopen(url).read())
        assert b"jointfitd" in page
        await process.stdout.readline()
        process.send_signal(signal.SIGINT)
        await process.communicate()
    assert process.returncode == 0


class AbortingDaemon:
    """Client of a daemon that aborts phases with the given reasons, and then completes a phase."""

    def __init__(self, *reasons: str) -> None:
        self.tracker = PhaseTracker(lambda *_: None)
        self.reasons = [*reasons]
        self.requests: list[str] = []

    async def request(self, _command: str, content: dict[str, object]) -> dict[str, object]:
        phase = str(content["phase"])
        self.requests.append(phase)
        self.tracker.on_status({"phase": phase})
        aborted = {"phase": "aborted", "text": self.reasons.pop(0)} if self.reasons else None
        self.tracker.on_status(aborted or {"phase": "aligned"})
        return {"status": "accepted"}

    async def align(self) -> None:
        await run_phase(cast("MqttClient", self), self.tracker, "align", 20.0)


RESTARTED = "S1 restarted during the phase: repeat it"


async def test_a_phase_that_a_busy_computer_ended_is_repeated() -> None:
    daemon = AbortingDaemon(RESTARTED, RESTARTED)
    await daemon.align()
    assert daemon.requests == ["align"] * 3


async def test_a_phase_that_ends_without_result_each_time_is_not_repeated_further() -> None:
    daemon = AbortingDaemon(*[RESTARTED] * 9)
    with pytest.raises(PhaseAbortedError, match="S1 restarted"):
        await daemon.align()
    assert daemon.requests == ["align"] * 3


async def test_a_phase_that_the_user_stopped_is_not_repeated() -> None:
    daemon = AbortingDaemon("align: abort requested")
    with pytest.raises(PhaseAbortedError):
        await daemon.align()
    assert daemon.requests == ["align"]
