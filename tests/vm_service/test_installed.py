"""Parts of the installed package: udev rules, signed requests, and unchanged files."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from machine import (
    BASE,
    UNIT,
    answer,
    eventually,
    messages,
    run,
    show,
    write_rig,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

KEY = Path("/etc/credstore/jointfitd.request-key")
SIGN = (
    "import json, sys; from jointfit_daemon.outputs.mqtt import sign_request; "
    "key = open(sys.argv[1], 'rb').read().strip(); "
    "print(json.dumps(sign_request(key, sys.argv[2], json.loads(sys.argv[3]))))"
)


def test_udev_reads_the_rules_and_reports_only_the_broken_rules_of_another_file() -> None:
    assert Path("/usr/lib/udev/rules.d/70-jointfitd.rules").is_file()
    broken = Path("/run/udev/rules.d/71-broken.rules")
    broken.parent.mkdir(parents=True, exist_ok=True)
    broken.write_text('SUBSYTEM=="tty", GROUP="dialout"\n')
    try:

        def complaints() -> str:  # udev reads changed rules at the next event
            run("udevadm", "control", "--reload")
            run("udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=net")
            said = run("journalctl", "-b", "-o", "cat", "-t", "systemd-udevd")
            return said if "71-broken.rules" in said else ""

        assert "70-jointfitd.rules" not in eventually(complaints, "udev reports the broken file")
    finally:
        broken.unlink()
        run("udevadm", "control", "--reload")


def test_the_installed_files_are_those_of_the_package() -> None:
    changed = run("dpkg", "--verify", "jointfitd", check=False).splitlines()
    # the image leaves out manual pages of all packages
    assert [line for line in changed if "/usr/share/man/" not in line] == []


def test_the_commands_have_their_manual_pages_in_the_package() -> None:
    listed = run("dpkg", "-L", "jointfitd").splitlines()
    for name in ("jointfitd", "jointfit", "jointfit-sim"):
        assert f"/usr/share/man/man1/{name}.1.gz" in listed


def test_the_unit_is_read_without_complaint() -> None:
    for unit in (UNIT, "jointfitd@x.service"):
        assert "jointfitd" not in run("systemd-analyze", "verify", "--man=no", unit)


@pytest.fixture
def key() -> Iterator[bytes]:
    """Install a key with which requests to the service must be signed; yield the key."""
    made = secrets.token_hex(32)
    KEY.write_text(f"{made}\n")
    KEY.chmod(0o600)
    yield made.encode()
    KEY.unlink()


def signed(request: dict[str, object]) -> str:
    """Return `request`, signed by the installed program."""
    topic = f"{BASE}/bridge/request/calibrate"
    words = ["/usr/lib/jointfitd/bin/python3", "-I", "-c", SIGN, str(KEY), topic]
    return run(*words, json.dumps(request))


def test_a_rig_with_a_key_takes_signed_requests_only(machine: None, key: bytes) -> None:
    write_rig(
        lambda text: text.replace(
            'username = "jointfitd"',
            'username = "jointfitd"\nrequest_key_file = "jointfitd.request-key"',
        )
    )
    run("systemctl", "start", UNIT)
    eventually(
        lambda: messages("bridge/state", seconds=2) == [{"v": 1, "state": "online"}], "online"
    )
    refused = answer("calibrate", phase="abort")
    assert refused["error"]["key"] == "signature"
    request = signed({"phase": "abort", "transaction": "1"})
    assert answer("calibrate", request)["status"] == "ok"
    assert "used already" in answer("calibrate", request)["error"]["message"]
    inside = Path(f"/proc/{show('MainPID')}/environ").read_bytes()
    assert key not in inside
