"""The daemon runs on other machines, which namespaces and environment variables simulate."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.experiment, pytest.mark.system, pytest.mark.timeout(300)]

YEARS_S = 20 * 365 * 86400
"""Uptime above 2**53 ns, s. A double cannot represent every nanosecond of such times."""
NO_IPV4 = 'ip link set lo up && ip -4 address flush dev lo && exec "$@"'
NO_HOSTS = 'mount --bind /dev/null /etc/hosts && exec "$@"'


def uptime(seconds: int) -> list[str]:
    """Return the command that runs a program with this uptime."""
    clocks = {"monotonic": time.CLOCK_MONOTONIC, "boottime": time.CLOCK_BOOTTIME}
    shifts = [
        f"--{name}={seconds - int(time.clock_gettime(clock))}" for name, clock in clocks.items()
    ]
    return ["unshare", "--user", "--map-root-user", "--time", "--fork", *shifts]


def inside(options: str, script: str) -> list[str]:
    """Return the command that runs a program in new namespaces after a script."""
    return ["unshare", "--user", "--map-root-user", *options.split(), "sh", "-ec", script, "sh"]


def run(command: list[str], **environment: str) -> str:
    """Run the gateway of `machine_run` by a command; return what it printed."""
    if command:
        tried = subprocess.run([*command, "true"], capture_output=True, text=True, check=False)
        if tried.returncode:
            pytest.skip(f"this kernel refuses the namespaces to this user: {tried.stderr.strip()}")
    done = subprocess.run(
        [*command, sys.executable, "-m", "tests.system.machine_run"],
        cwd=Path(__file__).parents[2], env=os.environ | environment, text=True,
        capture_output=True, check=False, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_daemon_runs_seconds_after_the_boot() -> None:
    text = run(uptime(5))
    assert 5 <= int(text.split()[1]) < 300


def test_the_daemon_runs_after_years_without_a_boot() -> None:
    text = run(uptime(YEARS_S))
    assert int(text.split()[1]) * 10**9 > 2**53


def test_the_daemon_runs_in_the_locale_c() -> None:
    run([], LC_ALL="C", PYTHONCOERCECLOCALE="0", PYTHONUTF8="0")


def test_the_daemon_runs_in_turkish(tmp_path: Path) -> None:
    # In Turkish, "I" has another lower-case letter, and the decimal sign is a comma.
    if shutil.which("localedef") is None or not Path("/usr/share/i18n/locales/tr_TR").is_file():
        pytest.skip("no sources of locales (Debian: apt install locales)")
    words = ["localedef", "-i", "tr_TR", "-f", "UTF-8", str(tmp_path / "tr_TR.UTF-8")]
    subprocess.run(words, check=True, capture_output=True)
    run([], LC_ALL="tr_TR.UTF-8", LOCPATH=str(tmp_path))


def test_the_daemon_runs_without_hosts_file() -> None:
    run(inside("--mount", NO_HOSTS))


def test_the_daemon_runs_on_ipv6_alone() -> None:
    run(inside("--net", NO_IPV4), JOINTFIT_TEST_HOST="::1")
