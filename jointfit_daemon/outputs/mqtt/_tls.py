"""TLS to a broker. Law: verified, always; TLS 1.2 at least; what fails is told with its remedy.

There is no way to switch verification off: a broker of one's own has a certificate authority of
one's own, and ``[mqtt.tls] ca`` names it.
"""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings, TlsSettings

# OpenSSL's X509_V_ERR_..., x509_vfy.h
_NOT_YET_VALID, _EXPIRED = 9, 10
_OTHER_NAME, _OTHER_ADDRESS = 62, 64
_PLAIN_ANSWERS = {"WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "HTTP_REQUEST"}


class _TlsSocket(ssl.SSLSocket):
    """A socket that does not stay open when nobody can be trusted; paho would leave it so."""

    def do_handshake(self, block: bool = False) -> None:  # type: ignore[explicit-override]  # 3.12's
        """Agree on keys, or close."""
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


class TlsFilesError(Exception):
    """The files of ``[mqtt.tls]`` cannot be used; the message says which and why."""


def tls_context(tls: TlsSettings) -> ssl.SSLContext:
    """Return what verifies the broker and, with a certificate, shows who we are.

    Raises
    ------
    TlsFilesError
        A file is missing, unreadable or no PEM, or key and certificate are not of one pair.
    """
    for name, path in (("ca", tls.ca), ("cert", tls.cert), ("key", tls.key)):
        _check_readable(name, path)
    try:
        context = ssl.create_default_context(cafile=tls.ca)
    except ssl.SSLError as error:
        raise TlsFilesError(f"ca = {tls.ca}: holds no certificate in PEM") from error
    context.sslsocket_class = _TlsSocket
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if tls.cert is not None:
        try:
            context.load_cert_chain(tls.cert, tls.key, password=_no_passphrase)
        except (ssl.SSLError, ValueError) as error:
            files = f"cert = {tls.cert}, key = {tls.key or tls.cert}"
            raise TlsFilesError(
                f"{files}: not a certificate and its own key, both in PEM, the key without a "
                "passphrase"
            ) from error
    return context


def _check_readable(name: str, path: str | None) -> None:
    if path is None:
        return
    try:
        Path(path).read_bytes()
    except OSError as error:
        raise TlsFilesError(f"{name} = {path}: {error.strerror}") from error


def _no_passphrase() -> str:
    """Answer OpenSSL, which would else ask on the terminal."""
    return ""


def tls_remedy(
    error: BaseException | None, settings: MqttSettings, *, established: bool = False
) -> str:
    """Return what to do about a connection that `error` kept from being made; empty: unknown.

    Parameters
    ----------
    error
        What ended it.
    settings
        Of the broker.
    established
        Whether our side of the TLS handshake completed. A broker that ends the connection after
        that has refused our certificate: in TLS 1.3 it is checked last, and the alert that says so
        is lost if the connection is reset at once.
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        return f" ({_distrust(error.verify_code, settings)})"
    if isinstance(error, ssl.SSLError) and "ALERT" in str(error.reason):
        return f" ({_refused(settings)})"
    plain = isinstance(error, ssl.SSLError) and error.reason in _PLAIN_ANSWERS
    cut = isinstance(error, ssl.SSLEOFError | ConnectionResetError)
    if settings.tls is not None and cut and established:
        return f" ({_refused(settings)})"
    if settings.tls is not None and (plain or cut):
        port = settings.tcp_port
        return f" (port {port} does not answer to TLS: set the port of the broker's TLS listener)"
    return ""


def _distrust(code: int, settings: MqttSettings) -> str:
    """Return what to do about a certificate that does not stand the check."""
    trusted = (settings.tls.ca if settings.tls else None) or "the system's certificates"
    if code == _EXPIRED:
        return "the broker's certificate has expired: renew it, or set this machine's clock"
    if code == _NOT_YET_VALID:
        return "the broker's certificate is not valid yet: is this machine's clock right?"
    if code in {_OTHER_NAME, _OTHER_ADDRESS}:
        return (
            f"the broker's certificate is for another name than {settings.host}: set host to a "
            "name in it, or give the broker one that names this host (subjectAltName)"
        )
    return (
        f"the broker's certificate is not signed by what {trusted} holds: name the certificate of "
        "the broker's authority in [mqtt.tls] ca"
    )


def _refused(settings: MqttSettings) -> str:
    if settings.tls is None or settings.tls.cert is None:
        return "the broker asks for a certificate of ours: set cert and key in [mqtt.tls]"
    return (
        f"the broker does not accept {settings.tls.cert}: is it expired, or signed by another "
        "authority than the broker's cafile?"
    )
