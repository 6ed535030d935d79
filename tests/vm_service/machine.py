"""Helpers for tests of the installed service: systemctl, the journal, mosquitto's clients."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

UNIT = "jointfitd.service"
RIG = Path("/etc/jointfitd/rig.toml")
SIM = Path("/run/jointfit-sim")
BASE = "jointfit/vm"
CA = "/etc/mosquitto/certs/ca.crt"
QUIET_S = 0.5
"""Longest duration of the work of ``slowness`` on an idle machine, s."""
TLS = f'[mqtt.tls]\nca = "{CA}"\n'


def run(*words: str, check: bool = True) -> str:
    """Return the output of a command."""
    done = subprocess.run(words, text=True, capture_output=True, check=False)
    assert not check or done.returncode == 0, f"{' '.join(words)}: {done.stdout}{done.stderr}"
    return done.stdout.strip()


def show(name: str, unit: str = UNIT) -> str:
    """Return a property of a unit."""
    return run("systemctl", "show", "-P", name, unit)


def eventually(claim: Callable[[], object], what: str, seconds: float = 60.0) -> Any:
    """Return the first true result of `claim`; fail with `what` after `seconds`.

    The default time is long enough for an overloaded machine. Only failing tests need it.
    """
    end = time.monotonic() + seconds
    while not (answer := claim()):
        assert time.monotonic() < end, f"not within {seconds:g} s: {what}; {show('StatusText')}"
        time.sleep(0.5)  # a check costs as much CPU time as the daemon in a second
    return answer


def slowness() -> float:
    """Return the factor by which this machine is slower than an idle machine, at least 1.

    The guest cannot measure the load of its host, so the time of fixed work is measured. Time
    limits apply to an idle machine and are multiplied by this factor.
    """
    began = time.monotonic()
    run("python3", "-I", "-c", "sum(k * k for k in range(1_000_000))")
    return max(1.0, (time.monotonic() - began) / QUIET_S)


def journal(since: str, unit: str = UNIT) -> str:
    """Return the log lines of the unit since a cursor (see ``cursor``)."""
    return run("journalctl", "-b", "-o", "cat", "-u", unit, f"--after-cursor={since}")


def cursor() -> str:
    """Return the cursor of the end of the journal."""
    last = run("journalctl", "-b", "-n", "0", "--show-cursor")
    return last.rpartition("-- cursor: ")[2].strip()


def messages(topic: str, count: int = 1, seconds: float = 10.0) -> list[Any]:
    """Return `count` messages below the base topic, which the viewer receives over TLS."""
    text = run(
        "mosquitto_sub", "-h", "localhost", "-p", "8883", "--cafile", CA, "-V", "mqttv5",
        "-u", "viewer", "-P", "look", "-t", f"{BASE}/{topic}", "-C", str(count),
        "-W", str(round(seconds)), check=False,
    )  # fmt: skip
    return [json.loads(line) for line in text.splitlines()]


@contextlib.contextmanager
def listening(topic: str, seconds: int = 240) -> Iterator[Iterator[Any]]:
    """Yield an iterator over the messages below the base topic, retained messages first.

    A single process receives all messages, because repeated starts of a client load the machine.
    """
    words = (
        "mosquitto_sub", "-h", "localhost", "-p", "8883", "--cafile", CA, "-V", "mqttv5",
        "-u", "viewer", "-P", "look", "-t", f"{BASE}/{topic}", "-W", str(seconds),
    )  # fmt: skip
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as heard:
        assert heard.stdout is not None
        try:
            yield (json.loads(line) for line in heard.stdout)
        finally:
            heard.terminate()


def ask(command: str, user: str = "operator", password: str = "ask", **arguments: object) -> None:
    """Send a request as a user of the broker."""
    run(
        "mosquitto_pub", "-h", "localhost", "-p", "8883", "--cafile", CA, "-V", "mqttv5",
        "-u", user, "-P", password, "-t", f"{BASE}/bridge/request/{command}", "-q", "1",
        "-m", json.dumps(arguments),
    )  # fmt: skip


def answer(command: str, text: str = "", /, **arguments: object) -> dict[str, Any]:
    """Return the daemon's answer to a request of the operator: `text`, or JSON of `arguments`."""
    found: dict[str, Any] = json.loads(
        run(
            "mosquitto_rr", "-h", "localhost", "-p", "8883", "--cafile", CA, "-V", "mqttv5",
            "-u", "operator", "-P", "ask", "-t", f"{BASE}/bridge/request/{command}", "-q", "1",
            "-e", f"{BASE}/bridge/response/{command}", "-W", "20",
            "-m", text or json.dumps(arguments),
        )
    )  # fmt: skip
    return found


def write_rig(change: Callable[[str], str] = lambda text: text) -> None:
    """Install the simulator's rig with TLS and a user, modified by `change`."""
    text = (SIM / "rig.toml").read_text()
    text = text.replace(
        'host = "localhost"\nport = 1883', 'host = "localhost"\nusername = "jointfitd"'
    )
    assert 'username = "jointfitd"' in text
    RIG.write_text(change(text + "\n" + TLS))
    RIG.chmod(0o644)


def give_ports() -> None:
    """Permit the unit's group to open the virtual serial ports, as udev does for real ports."""
    for link in SIM.glob("tty*"):
        with contextlib.suppress(FileNotFoundError):
            os.chown(link, 0, 20)  # dialout
            link.chmod(0o660)


def sim(command: str) -> None:
    """Send a command to the simulator."""
    with open("/run/sim.commands", "w") as fifo:  # noqa: PTH123 - a fifo
        fifo.write(f"{command}\n")
