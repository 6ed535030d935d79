"""`jointfit demo --web`: the URL comes first, with a QR code where a phone can use it."""

from __future__ import annotations

import asyncio
import signal
import sys
import urllib.request
from typing import TYPE_CHECKING

import pytest

from bench.rigs.gateway import cpu_s
from jointfit_daemon.tools.dashboard.addresses import ListenAddress
from jointfit_daemon.tools.demo._web import print_address
from tests.system.station import PATIENCE_S, restore_signals

if TYPE_CHECKING:
    from pathlib import Path

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
        assert cpu_s(process.pid) < 1.0  # the time until the URL on a machine without other load
        page = await asyncio.to_thread(lambda: urllib.request.urlopen(url).read())
        assert b"jointfitd" in page
        await process.stdout.readline()
        process.send_signal(signal.SIGINT)
        await process.communicate()
    assert process.returncode == 0
