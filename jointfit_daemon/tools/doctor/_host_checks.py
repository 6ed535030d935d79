"""Checks of the host: clock, disk, memory, processor, firewall."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from jointfit_daemon.device_search import Finding
from jointfit_daemon.supervisor.state_directory import state_directory
from jointfit_daemon.tools.discovery import read_attribute

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.tools.doctor._host import Host

LOW_DISK_BYTES, LEAST_DISK_BYTES = 1_000_000_000, 50_000_000
"""Free space below which a warning is reported, and below which an error is reported, bytes. An
hour of recording needs about 0.3 GB."""
LOW_MEMORY_KB = 200_000
"""Available memory below which a fit may fail, kB."""
_HARDWARE_GOVERNORS = ("intel_pstate", "amd-pstate-epp")
"""Processor drivers whose governor ``powersave`` scales the frequency with the load."""
_SERVICE_STATE = "/var/lib/jointfitd"


def check_clock(host: Host, *, needed: bool) -> Iterator[Finding]:
    """Yield the finding on clock synchronization.

    Without synchronization, the finding is a warning. It is an error if `needed` is set, because
    cameras send PTP time stamps.
    """
    synchronized = host.clock_is_synchronized()
    if synchronized is None:
        text = "the state of the clock cannot be read here"
        yield Finding("clock", "", "unknown", text, "timedatectl")
    elif synchronized:
        yield Finding("clock", "", "ok", "the system clock is synchronized")
    else:
        text = "the system clock is not synchronized: UNIX times of messages may be wrong"
        if needed:
            text += ", and so may the time stamps of cameras on PTP"
        remedy = "sudo timedatectl set-ntp true (or install chrony; for PTP: linuxptp)"
        yield Finding("clock", "", "error" if needed else "warning", text, remedy)


def check_disk(host: Host) -> Iterator[Finding]:
    """Yield findings about write access to the state directory and about free space."""
    folders = [state_directory().absolute()]
    if host.at(_SERVICE_STATE).is_dir():
        folders.append(host.at(_SERVICE_STATE))
    for k, folder in enumerate(folders):
        existing = next(place for place in (folder, *folder.parents) if place.exists())
        if k == 0 and not (existing.is_dir() and host.may_open(existing)):
            remedy = f"sudo chown {host.user} {existing}, or set STATE_DIRECTORY"
            text = f"{existing} cannot be written by {host.user}"
            yield Finding("disk", str(folder), "error", text, remedy)
            continue
        free = host.free_bytes(existing)
        text = f"{free / 1e9:.1f} GB free"
        if free < LOW_DISK_BYTES:
            level = "error" if free < LEAST_DISK_BYTES else "warning"
            remedy = f"delete old recordings: du -sh {folder}/*"
            yield Finding("disk", str(folder), level, f"{text}, expected at least 1 GB", remedy)  # type: ignore[arg-type]  # two literals
        else:
            yield Finding("disk", str(folder), "ok", text)


def check_memory(host: Host) -> Iterator[Finding]:
    """Yield the finding about the available memory."""
    found = re.search(r"MemAvailable:\s+(\d+)", read_attribute(host.root / "proc/meminfo") or "")
    if found is None:
        yield Finding("memory", "", "unknown", "/proc/meminfo cannot be read", "free -m")
        return
    available = int(found[1])
    text = f"{available // 1000} MB available"
    if available < LOW_MEMORY_KB:
        remedy = "stop other programs: ps -eo rss,comm --sort -rss | head"
        yield Finding("memory", "", "warning", f"{text}, expected at least 200 MB", remedy)
    else:
        yield Finding("memory", "", "ok", text)


def check_processor(host: Host) -> Iterator[Finding]:
    """Yield the finding on the frequency governor, which may keep the lowest frequency."""
    for folder in sorted((host.root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq")):
        governor = read_attribute(folder / "scaling_governor")
        driver = read_attribute(folder / "scaling_driver")
        if governor == "powersave" and driver not in _HARDWARE_GOVERNORS:
            yield Finding(
                "processor", folder.parent.name, "warning",
                "governor powersave: the processor stays at its lowest frequency",
                "echo schedutil | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
            )  # fmt: skip
            return
    yield Finding("processor", "", "ok", "no fixed low frequency")


def check_firewall(host: Host, server: str) -> Iterator[Finding]:
    """Yield the finding about the host's firewall, if a camera server sends no data."""
    settings = read_attribute(host.root / "etc/ufw/ufw.conf") or ""
    if re.search(r"^\s*ENABLED\s*=\s*yes", settings, re.MULTILINE | re.IGNORECASE):
        yield Finding(
            "firewall", "ufw", "warning", "ufw is enabled on this host, and may drop the frames",
            f"sudo ufw allow proto udp from {server}",
        )  # fmt: skip
    elif host.is_running("firewalld"):
        yield Finding(
            "firewall", "firewalld", "warning",
            "firewalld runs on this host, and may drop the frames",
            f"sudo firewall-cmd --zone=trusted --add-source={server}",
        )  # fmt: skip
    else:
        text = "other rules of this host's firewall cannot be read without root"
        yield Finding("firewall", "", "unknown", text, "sudo nft list ruleset")
