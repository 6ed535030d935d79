"""TLS to a real mosquitto with generated certificates: verification and messages."""

from __future__ import annotations

import shutil
import ssl
import subprocess
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from jointfit_daemon.config import MqttSettings, TlsSettings
from jointfit_daemon.outputs.mqtt import BrokerLostError
from jointfit_daemon.outputs.mqtt._connection import MqttConnection
from jointfit_daemon.outputs.mqtt._tls import TlsFilesError, tls_context, tls_remedy

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
HERE = "DNS:localhost,IP:127.0.0.1"


def openssl(*words: str | Path) -> None:
    done = subprocess.run(
        ["openssl", *map(str, words)], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def authority(folder: Path, name: str) -> None:
    openssl(
        "req", "-x509", *KEY, "-days", "2", "-subj", f"/CN={name}",
        "-keyout", folder / f"{name}.key", "-out", folder / f"{name}.crt",
    )  # fmt: skip


def certificate(folder: Path, name: str, ca: str, names: str = HERE, days: int = 2) -> None:
    key, request, extensions = (folder / f"{name}.{end}" for end in ("key", "csr", "ext"))
    openssl("req", *KEY, "-subj", f"/CN={name}", "-keyout", key, "-out", request)
    extensions.write_text(f"subjectAltName={names}\n")
    openssl(
        "x509", "-req", "-in", request, "-CA", folder / f"{ca}.crt", "-CAkey", folder / f"{ca}.key",
        "-CAcreateserial", "-days", str(days), "-extfile", extensions,
        "-out", folder / f"{name}.crt",
    )  # fmt: skip


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with certificates, and the authorities that signed them."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (Debian: apt install openssl)")
    folder = tmp_path_factory.mktemp("pki")
    authority(folder, "ours")
    authority(folder, "theirs")
    certificate(folder, "broker", "ours")
    certificate(folder, "expired", "ours", days=0)  # expires at its creation
    certificate(folder, "elsewhere", "ours", names="DNS:broker.example,IP:192.0.2.7")
    certificate(folder, "daemon", "ours")
    certificate(folder, "stranger", "theirs")
    return folder


@pytest.fixture
def broker(
    request: pytest.FixtureRequest, pki: Path, start_mosquitto: Callable[[str], Broker]
) -> Broker:
    """Return a broker with the certificate that the test names, by default a valid certificate."""
    name, *more = getattr(request, "param", ("broker",))
    listener = f"cafile {pki}/ours.crt\ncertfile {pki}/{name}.crt\nkeyfile {pki}/{name}.key\n"
    return start_mosquitto(listener + "".join(f"{line}\n" for line in more))


def settings(broker: Broker, host: str = "127.0.0.1", **tls: Any) -> MqttSettings:
    return MqttSettings(host=host, port=broker.port, base="jointfit/t", tls=TlsSettings(**tls))


async def said(settings: MqttSettings) -> str:
    """Return the error text of a connection that fails."""
    with pytest.raises(BrokerLostError) as lost:
        async with MqttConnection(settings):
            pass
    return str(lost.value)


async def test_broker_of_the_configured_authority_is_trusted(broker: Broker, pki: Path) -> None:
    for host in ("127.0.0.1", "localhost"):
        async with MqttConnection(settings(broker, host, ca=str(pki / "ours.crt"))) as connection:
            assert await connection.subscribe(["jointfit/t/bridge/state"]) == []


async def test_an_unknown_authority_is_refused(broker: Broker, pki: Path) -> None:
    for ca in (str(pki / "theirs.crt"), None):
        told = await said(settings(broker, ca=ca))
        assert "not signed by an authority in" in told
        assert "[mqtt.tls] ca" in told


@pytest.mark.parametrize("broker", [("expired",)], indirect=True)
async def test_an_expired_certificate_is_refused(broker: Broker, pki: Path) -> None:
    assert "has expired: renew it" in await said(settings(broker, ca=str(pki / "ours.crt")))


@pytest.mark.parametrize("broker", [("elsewhere",)], indirect=True)
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_a_certificate_of_another_host_is_refused(
    broker: Broker, pki: Path, host: str
) -> None:
    told = await said(settings(broker, host, ca=str(pki / "ours.crt")))
    assert f"for another name than {host}" in told


async def test_listener_without_tls_is_reported(mosquitto: Broker, pki: Path) -> None:
    told = await said(settings(mosquitto, ca=str(pki / "ours.crt")))
    assert "does not answer to TLS" in told


@pytest.mark.parametrize("broker", [("broker", "require_certificate true")], indirect=True)
async def test_broker_accepts_the_configured_client_certificate_only(
    broker: Broker, pki: Path
) -> None:
    ca = str(pki / "ours.crt")

    def by(name: str) -> MqttSettings:
        return settings(broker, ca=ca, cert=str(pki / f"{name}.crt"), key=str(pki / f"{name}.key"))

    async with MqttConnection(by("daemon")) as connection:
        assert await connection.subscribe(["jointfit/t/bridge/state"]) == []
    assert "does not accept" in await said(by("stranger"))
    assert "set cert and key in [mqtt.tls]" in await said(settings(broker, ca=ca))


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({"ca": "nowhere.crt"}, "nowhere.crt: No such file"),
        ({"ca": "daemon.key"}, "contains no certificate"),
        ({"cert": "daemon.crt", "key": "broker.key"}, "expected a certificate and its own key"),
        ({"cert": "daemon.crt"}, "expected a certificate and its own key"),
        ({"cert": "daemon.crt", "key": "locked.key"}, "without a passphrase"),
    ],
)
def test_files_that_cannot_be_used_are_named(pki: Path, files: dict[str, str], told: str) -> None:
    openssl(
        "ec", "-in", pki / "daemon.key", "-aes128", "-passout", "pass:abcd",
        "-out", pki / "locked.key",
    )  # fmt: skip
    with pytest.raises(TlsFilesError, match=told):
        tls_context(TlsSettings(**{key: str(pki / name) for key, name in files.items()}))


def test_verification_is_on_and_tls_is_1_2_at_least() -> None:
    context = tls_context(TlsSettings())
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.check_hostname
    assert context.minimum_version == ssl.TLSVersion.TLSv1_2


@pytest.mark.parametrize("host", ["broker.lab", "192.168.1.4", "example.org", "2001:db8::1"])
def test_remote_broker_requires_tls_or_insecure(host: str) -> None:
    with pytest.raises(ValidationError, match="insecure = true"):
        MqttSettings(host=host)
    assert MqttSettings(host=host, tls=TlsSettings()).tcp_port == 8883
    assert MqttSettings(host=host, insecure=True).tcp_port == 1883


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.9.9.9", "::1"])
def test_local_broker_requires_neither_tls_nor_insecure(host: str) -> None:
    assert MqttSettings(host=host).is_local


def test_a_key_without_its_certificate_is_a_fault() -> None:
    with pytest.raises(ValidationError, match="set cert, too"):
        TlsSettings(key="x")


def test_tls_remedy_names_the_certificate_if_the_handshake_was_completed() -> None:
    secure = MqttSettings(host="127.0.0.1", base="jointfit/t", tls=TlsSettings())
    reset = ConnectionResetError()
    assert "does not answer to TLS" in tls_remedy(reset, secure)
    assert "requires a client certificate" in tls_remedy(reset, secure, established=True)


@pytest.mark.parametrize(
    ("reason", "told"),
    [
        ("TLSV13_ALERT_CERTIFICATE_REQUIRED", "requires a client certificate"),
        ("SSLV3_ALERT_HANDSHAKE_FAILURE", "requires a client certificate"),
        ("TLSV1_ALERT_UNKNOWN_CA", "requires a client certificate"),
        ("TLSV1_ALERT_PROTOCOL_VERSION", "with the TLS alert TLSV1_ALERT_PROTOCOL_VERSION"),
        ("TLSV1_ALERT_INTERNAL_ERROR", "with the TLS alert TLSV1_ALERT_INTERNAL_ERROR"),
    ],
)
def test_only_alerts_about_certificates_blame_the_certificate_of_the_client(
    reason: str, told: str
) -> None:
    error = ssl.SSLError()
    error.reason = reason
    secure = MqttSettings(host="broker", base="jointfit/t", tls=TlsSettings())
    assert told in tls_remedy(error, secure)


@pytest.mark.parametrize(
    ("code", "told"), [(20, "not signed by an authority in"), (66, "not valid: EE certificate key")]
)
def test_a_faulty_certificate_is_not_called_untrusted(code: int, told: str) -> None:
    error = ssl.SSLCertVerificationError()
    error.verify_code, error.verify_message = code, "EE certificate key too weak"
    secure = MqttSettings(host="broker", base="jointfit/t", tls=TlsSettings())
    assert told in tls_remedy(error, secure)
