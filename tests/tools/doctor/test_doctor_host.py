"""Each fault of ports, CAN interfaces and host yields a warning, an error or a note."""

from __future__ import annotations

import ctypes
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.doctor import _host, _host_checks
from jointfit_daemon.tools.doctor._can_checks import check_can
from jointfit_daemon.tools.doctor._host import Host
from jointfit_daemon.tools.doctor._serial_checks import check_serial
from tests.tools.discovery.host_tree import FTDI_LINK, add_can, add_port, link, write

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.device_search import Finding

PORT = f"/dev/serial/by-id/{FTDI_LINK}"
TIME_ERROR = 5
"""State that adjtimex returns for a clock that is not synchronized (adjtimex(2))."""


def gateway(root: Path, **facts: Any) -> Host:
    """Return a host whose user may open all files; the root is a directory of the test."""
    sound: dict[str, Any] = {
        "run": lambda _: None, "user": "lab", "groups": frozenset({"lab", "dialout"}),
        "may_open": lambda _: True, "group_of": lambda _: "dialout",
        "members": lambda _: frozenset(), "free_bytes": lambda _: 10**11,
        "clock_is_synchronized": lambda: True,
    }  # fmt: skip
    return Host(root, **(sound | facts))


def add_process(root: Path, number: int, name: str, *files: str) -> None:
    write(root / f"proc/{number}/comm", name)
    (root / f"proc/{number}/fd").mkdir()
    for k, file in enumerate(files):
        link(root / f"proc/{number}/fd/{k}", file)


def faults(found: Any) -> list[Finding]:
    return [each for each in found if each.level in ("warning", "error")]


def one(found: Any, level: str) -> Finding:
    (match,) = [each for each in found if each.level == level]
    return match  # type: ignore[no-any-return]  # a Finding


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return the root of a host with one FTDI adapter that is configured well."""
    add_port(tmp_path, "ttyUSB0", "ftdi_sio", latency_ms=1, by_id=FTDI_LINK)
    return tmp_path


def test_a_sound_port_has_no_finding_but_ok(tree: Path) -> None:
    for paths in (None, [PORT]):
        (found,) = check_serial(gateway(tree), paths)
        assert (found.level, found.id) == ("ok", PORT)


def test_an_absent_port_is_an_error_that_lists_the_others(tree: Path) -> None:
    (found,) = check_serial(gateway(tree), ["/dev/ttyUSB7"])
    assert found.level == "error"
    assert PORT in found.text


def refused(**facts: Any) -> dict[str, Any]:
    return {"may_open": lambda _: False, "groups": frozenset({"lab"})} | facts


@pytest.mark.parametrize(
    ("facts", "text", "remedy"),
    [
        (refused(), "not in the group dialout", "sudo usermod -aG dialout lab"),
        (refused(members=lambda _: frozenset({"lab"})), "after the login", "newgrp dialout"),
        (refused(group_of=lambda _: "root"), "only root", "70-jointfitd.rules"),
        (refused(groups=frozenset({"dialout"})), "may not read and write", "70-jointfitd.rules"),
    ],
)
def test_a_refused_port_names_the_missing_right(
    tree: Path, facts: dict[str, Any], text: str, remedy: str
) -> None:
    (found,) = check_serial(gateway(tree, **facts), [PORT])
    assert found.level == "error"
    assert text in found.text
    assert remedy in found.remedy


def test_modemmanager_is_a_warning_unless_a_rule_excludes_the_port(tree: Path) -> None:
    add_process(tree, 77, "ModemManager")
    found = one(check_serial(gateway(tree), None), "warning")
    assert "ModemManager" in found.text
    assert "systemctl disable --now ModemManager" in found.remedy

    write(tree / "run/udev/data/c188:0", "S:jointfit/imu-A0\nE:ID_MM_DEVICE_IGNORE=1")
    assert faults(check_serial(gateway(tree), None)) == []


def test_another_program_on_the_port_is_named(tree: Path) -> None:
    add_process(tree, 4711, "minicom", "/dev/ttyUSB0")
    found = one(check_serial(gateway(tree), [PORT]), "error")
    assert "minicom (process 4711)" in found.text
    assert found.remedy == "close this program: kill 4711"


def test_the_daemon_on_the_port_is_a_note(tree: Path) -> None:
    add_process(tree, 4711, "jointfitd", "/dev/ttyUSB0", "/dev/null")
    found = list(check_serial(gateway(tree), [PORT]))
    assert faults(found) == []
    assert "jointfitd (process 4711)" in one(found, "note").text


def test_a_slow_adapter_is_a_note_and_in_use_a_warning(tmp_path: Path) -> None:
    add_port(tmp_path, "ttyUSB0", "ftdi_sio", latency_ms=16, by_id=FTDI_LINK)
    idle = one(check_serial(gateway(tmp_path), [PORT]), "note")
    assert "16 ms" in idle.text
    assert "echo 1 | sudo tee /sys/class/tty/ttyUSB0/device/latency_timer" in idle.remedy
    add_process(tmp_path, 4711, "jointfitd", "/dev/ttyUSB0")
    assert "16 ms" in one(check_serial(gateway(tmp_path), [PORT]), "warning").text


def can_host(root: Path, *, up: bool = True, **data: Any) -> Host:
    add_can(root, "can0", up=up)
    known = {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 1_000_000}, "restart_ms": 100}
    link_info = [{"linkinfo": {"info_kind": "can", "info_data": known | data}}]
    return gateway(root, run=lambda _: json.dumps(link_info))


def test_a_sound_interface_has_no_finding_but_ok(tmp_path: Path) -> None:
    host = can_host(tmp_path)
    for bitrates in (None, {"can0": 1_000_000}):
        (found,) = check_can(host, bitrates)
        assert (found.level, found.id) == ("ok", "can0")


@pytest.mark.parametrize(
    ("data", "level", "text", "remedy"),
    [
        ({"state": "BUS-OFF"}, "error", "bus-off", "sudo ip link set can0 down && sudo ip link"),
        ({"state": "ERROR-PASSIVE"}, "warning", "error-passive", "120 Ω"),
        ({"state": "ERROR-WARNING"}, "warning", "error-warning", "120 Ω"),
        (
            {"bittiming": {"bitrate": 500_000}}, "error", "bit rate 500000, rig.toml expects",
            "type can bitrate 1000000",
        ),
        ({"up": False}, "error", "is down", "sudo ip link set can0 up type can bitrate 1000000"),
        ({"restart_ms": 0}, "note", "does not restart", "restart-ms 100"),
        ({"ctrlmode": ["LISTEN-ONLY"]}, "note", "listen-only", "listen-only off"),
    ],
)  # fmt: skip
def test_each_state_of_a_controller_has_its_finding(
    tmp_path: Path, data: dict[str, Any], level: str, text: str, remedy: str
) -> None:
    found = one(check_can(can_host(tmp_path, **data), {"can0": 1_000_000}), level)
    assert text in found.text
    assert remedy in found.remedy


def test_an_absent_interface_is_an_error_and_one_without_ip_is_unknown(tmp_path: Path) -> None:
    add_can(tmp_path, "can0")
    add_can(tmp_path, "vcan0", driver=None, up=False)
    absent, unreadable, down = faults_and_unknown(
        check_can(gateway(tmp_path), {"can7": 1_000_000, "can0": 1_000_000, "vcan0": 500_000})
    )
    assert (absent.level, absent.text) == ("error", "absent; this host has can0, vcan0")
    assert (unreadable.level, unreadable.remedy) == ("unknown", "sudo apt install iproute2")
    assert down.remedy == "sudo ip link set vcan0 up"


def faults_and_unknown(found: Any) -> list[Finding]:
    return [each for each in found if each.level not in ("ok", "note")]


@pytest.mark.parametrize(
    ("synchronized", "needed", "level"),
    [
        (True, True, "ok"),
        (False, False, "warning"),
        (False, True, "error"),
        (None, True, "unknown"),
    ],
)
def test_the_clock_must_be_synchronized(
    tmp_path: Path, synchronized: bool | None, needed: bool, level: str
) -> None:
    host = gateway(tmp_path, clock_is_synchronized=lambda: synchronized)
    (found,) = _host_checks.check_clock(host, needed=needed)
    assert found.level == level
    assert (found.remedy == "") == (level == "ok")


def test_the_status_of_the_clock_agrees_with_the_state_that_the_kernel_returns() -> None:
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(256))
    assert _host.clock_is_synchronized() == (state != TIME_ERROR)


@pytest.mark.parametrize(
    ("free", "level"), [(2 * 10**9, "ok"), (10**8, "warning"), (10**6, "error")]
)
def test_a_full_disk_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, level: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    (found,) = _host_checks.check_disk(gateway(tmp_path, free_bytes=lambda _: free))
    assert (found.level, found.id) == (level, str(tmp_path / "state"))


def test_a_state_directory_without_write_access_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    (found,) = _host_checks.check_disk(gateway(tmp_path, may_open=lambda _: False))
    assert found.level == "error"
    assert found.remedy == f"sudo chown lab {tmp_path}, or set STATE_DIRECTORY"
    assert not (tmp_path / "state").exists()  # the check creates nothing


def test_little_memory_is_a_warning(tmp_path: Path) -> None:
    levels = []
    for available in (4_000_000, 90_000, None):
        text = "" if available is None else f"MemTotal: 1 kB\nMemAvailable:   {available} kB"
        write(tmp_path / "proc/meminfo", text)
        levels += [found.level for found in _host_checks.check_memory(gateway(tmp_path))]
    assert levels == ["ok", "warning", "unknown"]


@pytest.mark.parametrize(
    ("governor", "driver", "level"),
    [
        ("powersave", "cpufreq-dt", "warning"),
        ("powersave", "intel_pstate", "ok"),
        ("schedutil", "cpufreq-dt", "ok"),
    ],
)
def test_a_governor_that_stays_slow_is_a_warning(
    tmp_path: Path, governor: str, driver: str, level: str
) -> None:
    folder = tmp_path / "sys/devices/system/cpu/cpu0/cpufreq"
    write(folder / "scaling_governor", governor)
    write(folder / "scaling_driver", driver)
    (found,) = _host_checks.check_processor(gateway(tmp_path))
    assert found.level == level


def ufw(root: Path) -> None:
    write(root / "etc/ufw/ufw.conf", "# comment\nENABLED=yes\nLOGLEVEL=low")


def firewalld(root: Path) -> None:
    add_process(root, 5, "firewalld")


@pytest.mark.parametrize(
    ("prepare", "remedy"),
    [(ufw, "sudo ufw allow proto udp from 10.0.0.2"), (firewalld, "--add-source=10.0.0.2")],
)
def test_an_enabled_firewall_is_named_with_its_command(
    tmp_path: Path, prepare: Callable[[Path], None], remedy: str
) -> None:
    write(tmp_path / "etc/ufw/ufw.conf", "ENABLED=no")
    (before,) = _host_checks.check_firewall(gateway(tmp_path), "10.0.0.2")
    assert before.level == "unknown"
    prepare(tmp_path)
    (found,) = _host_checks.check_firewall(gateway(tmp_path), "10.0.0.2")
    assert found.level == "warning"
    assert remedy in found.remedy


def test_the_facts_of_this_host_are_read_without_root() -> None:
    host = Host()
    assert host.user
    assert host.groups
    assert (os.getpid(), Path("/proc/self/comm").read_text().strip()) in [
        (number, name) for number, name, _ in host.processes()
    ]
    assert host.is_running(Path("/proc/self/comm").read_text().strip())


def test_a_real_pseudo_terminal_is_held_by_this_process_which_is_no_fault(tmp_path: Path) -> None:
    controller, line = os.openpty()
    (tmp_path / "imu").symlink_to(os.ttyname(line))  # jointfit-sim creates such a link
    holders = Host().holders(Path(os.ttyname(line)))
    (found,) = check_serial(Host(), [str(tmp_path / "imu")])
    os.close(controller)
    os.close(line)
    assert os.getpid() in [number for number, _ in holders]
    assert found.level == "ok"
