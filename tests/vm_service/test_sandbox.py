"""Operations that the unit forbids or permits, tried by a probe that runs under the same unit."""

from __future__ import annotations

import errno
import json
import shutil
import socket
from pathlib import Path

import pytest

from machine import SIM, UNIT, cursor, eventually, give_ports, journal, run

PROBE = "jointfit-probe.service"
UNIT_FILE = Path("/usr/lib/systemd/system") / UNIT
CAN_DROP_IN = Path("/usr/share/jointfitd/systemd/jointfitd-can.conf")


@pytest.fixture(scope="module")
def found() -> dict[str, int]:
    """Return the errno of each operation of the probe, with the drop-in for CAN."""
    return probe(UNIT_FILE.read_text() + CAN_DROP_IN.read_text())


def probe(text: str) -> dict[str, int]:
    """Run the probe under a unit with this text; return the errno of each operation."""
    program = Path("/usr/local/lib/jointfit-probe.py")
    shutil.copyfile(Path(__file__).with_name("probe.py"), program)
    program.chmod(0o644)
    start = next(line for line in text.splitlines() if line.startswith("ExecStart="))
    port = SIM / "ttyS1"
    eventually((SIM / "rig.toml").is_file, "the simulator is ready")
    give_ports()
    text = text.replace(start, f"ExecStart=/usr/bin/python3 {program} {port.resolve()}")
    (Path("/run/systemd/system") / PROBE).write_text(text)
    run("systemctl", "daemon-reload")
    since = cursor()
    run("systemctl", "start", PROBE)
    lines = journal(since, PROBE).splitlines()
    run("systemctl", "stop", PROBE)
    line = next(line for line in lines if line.startswith("PROBE "))
    answer: dict[str, int] = json.loads(line.removeprefix("PROBE "))
    return answer


FORBIDDEN = (
    "write /usr", "write /etc", "write /etc/jointfitd", "write /var/lib", "write /opt",
    "read /home", "read /root", "open /dev/kmsg", "open /dev/net/tun", "open a disk",
    "raw socket", "packet socket", "netlink socket", "own namespace", "mount", "host name",
    "clock", "ptrace", "code that can be written", "new capability", "setuid",
    "public network", "shared memory", "keyring", "io_uring", "memory of processes",
)  # fmt: skip
NEEDED = (
    "may write its state", "may open its port", "may speak CAN", "may speak UDP",
    "may speak to 10.x", "may speak to 192.168.x", "may speak to cameras by multicast",
)  # fmt: skip


@pytest.mark.parametrize("what", FORBIDDEN)
def test_sandbox_denies_the_operation(found: dict[str, int], what: str) -> None:
    assert found[what] != 0


@pytest.mark.parametrize("what", NEEDED)
def test_sandbox_permits_required_operations(found: dict[str, int], what: str) -> None:
    assert found[what] == 0


def test_the_unit_without_drop_in_permits_no_can() -> None:
    found = probe(UNIT_FILE.read_text())
    assert found["may speak CAN"] == errno.EAFNOSUPPORT
    assert {found[what] for what in NEEDED if what != "may speak CAN"} == {0}


def test_every_attempt_is_judged(found: dict[str, int]) -> None:
    assert set(found) == {*FORBIDDEN, *NEEDED}


def test_root_outside_the_unit_is_not_refused() -> None:
    # Without the unit the operations succeed, so the errnos above are an effect of the unit.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker:
        assert speaker.sendto(b"x", ("198.51.100.7", 1511)) == 1
    assert Path("/root").is_dir()
    probe = Path("/usr/probe")
    probe.write_text("x")
    probe.unlink()


def test_the_exposure_is_low() -> None:
    said = run("systemd-analyze", "security", "--no-pager", UNIT).splitlines()[-1]
    exposure = float(said.partition("level for")[2].partition(":")[2].split()[0])
    assert exposure <= 1.4  # with the drop-in for CAN; check_unit.py measures the unit alone
