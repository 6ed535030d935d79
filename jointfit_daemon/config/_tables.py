"""The tables of rig.toml that belong to the daemon itself, one model each.

Law: unknown keys are refused, every field says what it is and in which unit; this text is what
``jointfit schema`` prints. The tables of devices belong to their drivers.
"""

from __future__ import annotations

import ipaddress
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from jointfit_daemon.driver import Settings
from jointfit_daemon.limb_model import Method  # noqa: TC001 - pydantic reads it at run time

_PLAIN, _TLS = 1883, 8883  # IANA: mqtt, secure-mqtt


class RigTable(Settings):
    """``[rig]``."""

    name: str = Field(description="name of the rig; becomes an MQTT topic")
    output_rate_hz: float = Field(100.0, gt=0, le=1000, description="limb states per second, Hz")
    align_mode: Literal["smooth", "fast"] = Field(
        "smooth",
        description="`smooth` waits for samples on both sides of an instant and interpolates; "
        "`fast` is a sample period earlier and extrapolates by that at most",
    )


class ChainTable(Settings):
    """``[chain]``: the limb, from proximal to distal."""

    joints: tuple[str, ...] = Field(
        min_length=2, description="joints from proximal to distal, one more than segments"
    )
    segments: tuple[str, ...] = Field(min_length=1, description="segments between the joints")
    side: Literal["right", "left"] = Field("right", description="side of the body: sign of angles")
    proximal: str | None = Field(
        None, description="body part before the first joint, seen by markers only (pelvis)"
    )
    distal: str | None = Field(
        None, description="body part after the last joint, seen by markers only (foot)"
    )
    axes: Literal["anatomical", "static"] = Field(
        "anatomical",
        description="axes of the segments: `anatomical` from joint centers and the flexion axis; "
        "`static` those of the optical world while the wearer stood still, facing its +y",
    )
    origin_m: tuple[float, float, float] | None = Field(
        None, description="fixed position of the first joint in the world, m"
    )
    lengths_m: dict[str, float] = Field(
        default_factory=dict, description="known segment lengths, m; calibration finds the others"
    )


class CalibrationTable(Settings):
    """``[calibration]``."""

    store: str = Field(
        "default", description="name of the calibration's folder under $STATE_DIRECTORY"
    )
    method: Method = Field("anchored", description="how redundant sensors are combined")
    static_s: float = Field(5.0, gt=0, le=120, description="length of the static pose, s")
    align_s: float = Field(30.0, gt=0, le=600, description="length of the align phase, s")
    functional_s: float = Field(
        60.0, gt=0, le=600, description="greatest length of the movement phase, s"
    )
    functional_min_s: float = Field(
        45.0,
        ge=0,
        le=600,
        description="least length of the movement phase, s; it ends itself when every joint "
        "center is known to center_target_mm and every joint bent far and often enough",
    )
    center_target_mm: float = Field(
        3.0,
        gt=0,
        le=100,
        description="wanted error of the joint centers by noise, mm; skin motion comes on top "
        "and is told beside it",
    )
    holdout_share: float = Field(
        0.4, gt=0, lt=1, description="last share of the movement, which judges the fit"
    )
    refine_markers: bool = Field(
        True,
        description="whether the movement refines where single markers sit on their body parts",
    )
    learn_online: bool = Field(
        True,
        description="whether the models go on learning while the cameras see the limb; what is "
        "learned is taken only if it is better on the newest movement",
    )


def is_this_host(host: str) -> bool:
    """Return whether `host` is the loopback of this machine, by name or address."""
    if host == "localhost" or host.endswith(".localhost"):  # RFC 6761
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class TlsSettings(Settings):
    """``[mqtt.tls]``: files in PEM; relative names start at the folder of rig.toml."""

    ca: str | None = Field(None, description="certificates to trust; default: the system's")
    cert: str | None = Field(None, description="own certificate, for brokers that ask for one")
    key: str | None = Field(
        None, description="private key of `cert`; default: it is in the same file"
    )

    @field_validator("key")
    @classmethod
    def _has_its_certificate(cls, key: str | None, info: ValidationInfo) -> str | None:
        if key is not None and info.data.get("cert") is None:
            raise ValueError("a key without its certificate: set cert, too")
        return key


class MqttSettings(Settings):
    """``[mqtt]``."""

    host: str = Field("127.0.0.1", min_length=1, description="name or address of the broker")
    port: int = Field(0, ge=0, le=65535, description="TCP port; 0: 1883, or 8883 with tls")
    base: str = Field("", description="first levels of every topic; default jointfit/<rig name>")
    username: str | None = Field(None, description="user name for the broker")
    password_file: str | None = Field(
        None,
        description="file that holds the password; default: the systemd credential "
        "jointfitd.mqtt-password",
    )
    tls: TlsSettings | None = Field(None, description="talk TLS to the broker")
    insecure: bool = Field(
        False,
        validate_default=True,
        description="`true`: no TLS to a broker on another machine; who is on the way reads and "
        "writes all",
    )
    request_key_file: str | None = Field(
        None,
        description="file that holds the key which requests must be signed with; a systemd "
        "credential of the same name is taken first. Default: the broker decides who may ask",
    )
    version: Literal["5", "3.1.1"] = Field(
        "5", description="MQTT version; never changed silently: an old broker needs `3.1.1`"
    )
    pose_ui_hz: float = Field(10.0, gt=0, le=30, description="rate of the topic pose/ui, Hz")
    joint_hz: float = Field(1.0, gt=0, le=1, description="rate of the topics joint/NAME, Hz")
    health_s: float = Field(10.0, gt=0, le=60, description="time between two bridge/health, s")

    @field_validator("insecure")
    @classmethod
    def _is_protected(cls, insecure: bool, info: ValidationInfo) -> bool:
        if not {"host", "tls"} <= info.data.keys():
            return insecure  # wrong themselves, and told
        host: str = info.data["host"]
        if not (insecure or info.data["tls"] is not None or is_this_host(host)):
            raise ValueError(
                f"broker {host!r} is on another machine and [mqtt.tls] is missing: add it (with ca "
                "for a broker of your own), or allow plain MQTT with insecure = true"
            )
        return insecure

    @property
    def is_local(self) -> bool:
        """Whether what we say to the broker stays on this machine."""
        return is_this_host(self.host)

    @property
    def tcp_port(self) -> int:
        """The port to connect to."""
        return self.port or (_TLS if self.tls else _PLAIN)


class RecordingSettings(Settings):
    """``[recording]``: its presence makes the daemon keep a log of all its input events."""

    directory: str = Field(
        "recordings", description="folder; a relative name starts at $STATE_DIRECTORY"
    )
