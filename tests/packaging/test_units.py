"""The files for systemd and udev: their settings, and the documentation of the settings."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jointfit_daemon.__main__ import EXIT_IN_USE, EXIT_USAGE
from jointfit_daemon.outputs.mqtt._secret_files import CREDENTIAL
from jointfit_daemon.supervisor.daemon import STOP_S

ROOT = Path(__file__).resolve().parents[2]
SYSTEMD = ROOT / "systemd"
ONE, MANY = SYSTEMD / "jointfitd.service", SYSTEMD / "jointfitd@.service"
GUIDE = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")


def directives(unit: Path) -> list[tuple[str, str]]:
    """Return the settings of a unit in order, without comments."""
    lines = [line for line in unit.read_text().splitlines() if re.match(r"[A-Za-z]+=", line)]
    return [(name, value) for name, _, value in (line.partition("=") for line in lines)]


def setting(name: str) -> str:
    found = [value for key, value in directives(ONE) if key == name]
    assert len(found) == 1
    return found[0]


def test_both_units_differ_only_where_the_instance_is_named() -> None:
    one, many = directives(ONE), directives(MANY)
    assert [name for name, _ in one] == [name for name, _ in many]
    different = {a[0] for a, b in zip(one, many, strict=True) if a != b}
    assert different == {
        "Description", "ExecStart", "StateDirectory", "RuntimeDirectory", "LogsDirectory",
        "LoadCredential",
    }  # fmt: skip
    assert all("%i" in b[1] for a, b in zip(one, many, strict=True) if a != b)


def test_only_a_usage_error_or_a_used_directory_prevents_a_restart() -> None:
    assert setting("Restart") == "always"
    assert setting("RestartPreventExitStatus") == f"{EXIT_USAGE} {EXIT_IN_USE}"
    assert setting("StartLimitIntervalSec") == "0"
    assert "ExecStartPre" not in dict(directives(ONE))  # a failed ExecStartPre restarts without end


def test_the_shipped_times_are_the_documented_ones() -> None:
    assert setting("Type") == "notify"
    assert setting("RestartSec") == "2"
    assert "| restart | 2 s after any exit except with codes 2 and 3; the number" in GUIDE
    assert "number of restarts is not limited |" in GUIDE
    assert setting("WatchdogSec") == "10"
    assert "| watchdog | 10 s (`WatchdogSec=`)" in GUIDE
    assert setting("TimeoutStopSec") == "15"
    assert f"abandoned after {STOP_S:g} s; systemd kills the process after 15 s" in GUIDE
    assert setting("MemoryMax") == "512M"
    assert "at most 512 MB" in GUIDE


def test_unit_passes_the_credentials_that_the_daemon_reads() -> None:
    named = {value.partition(":")[0] for key, value in directives(ONE) if key == "LoadCredential"}
    assert named == {CREDENTIAL, "jointfitd.request-key"}
    assert all(f"/etc/credstore/{name}" in GUIDE for name in named)


def test_drop_in_gives_only_the_main_thread_real_time_priority() -> None:
    drop_in = dict(directives(SYSTEMD / "jointfitd-realtime.conf"))
    assert drop_in == {
        "CPUSchedulingPolicy": "rr",
        "CPUSchedulingPriority": "10",
        "CPUSchedulingResetOnFork": "yes",
    }
    assert f"SCHED_RR|SCHED_RESET_ON_FORK, priority {drop_in['CPUSchedulingPriority']}" in GUIDE
    builder = (ROOT / "packaging" / "deb.py").read_text()
    assert '"systemd/jointfitd-realtime.conf": "usr/share/jointfitd/systemd"' in builder
    assert "/usr/share/jointfitd/systemd/jointfitd-realtime.conf" in GUIDE


def test_units_are_read_without_complaint_and_little_is_exposed() -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd is not installed (Debian: apt install systemd)")
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "check_unit.py")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_serial_ports_are_named_by_serial_number_never_by_vendor_alone() -> None:
    rules = [
        line
        for line in (SYSTEMD / "70-jointfitd.rules").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    named = [line for line in rules if "SYMLINK" in line]
    assert named
    for line in named:
        assert 'ENV{ID_SERIAL_SHORT}=="?*"' in line
        assert 'GROUP:="dialout"' in line  # final: a later rule must not take the port away
        assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in line
    assert any('ATTR{latency_timer}="1"' in line for line in rules)


def test_can_unit_neither_delays_the_boot_nor_uses_optional_adapter_features() -> None:
    text = (SYSTEMD / "80-jointfit-can0.network").read_text()
    active = [line for line in text.splitlines() if not line.startswith("#")]
    assert "RequiredForOnline=no" in active
    assert "BitRate=1M" in active
    assert not any(line.startswith("RestartSec") for line in active)


def test_the_broker_example_has_tls_access_rights_and_no_anonymous_clients() -> None:
    lines = (SYSTEMD / "mosquitto" / "jointfitd.conf").read_text().splitlines()
    for wanted in ("allow_anonymous false", "tls_version tlsv1.2", "listener 1883 127.0.0.1"):
        assert wanted in lines
    assert "A broker of your own" in (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
