"""TLS connections to a broker.

Invariant: certificates are always verified, and the TLS version is at least 1.2. Verification
cannot be switched off. A private broker needs the certificate of its private certificate authority
in ``[mqtt.tls] ca``.
"""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings, TlsSettings

# Error numbers of OpenSSL, X509_V_ERR_… in x509_vfy.h.
_NOT_YET_VALID, _EXPIRED = 9, 10
_OTHER_NAME, _OTHER_ADDRESS = 62, 64
_UNTRUSTED = {2, 18, 19, 20, 21}
"""OpenSSL's codes of a chain that ends at no trusted authority."""
_REJECTIONS = ("CERTIFICATE", "UNKNOWN_CA", "ACCESS_DENIED", "HANDSHAKE_FAILURE", "DECRYPT_ERROR")
"""Parts of the names of the alerts with which a broker rejects the certificate of a client."""
_PLAIN_ANSWERS = {"WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "HTTP_REQUEST"}
"""Reasons that OpenSSL reports if the peer does not use TLS."""


class _ClosingTlsSocket(ssl.SSLSocket):
    """A TLS socket that closes if its handshake fails, because paho would leave it open."""

    def do_handshake(self, block: bool = False) -> None:  # type: ignore[explicit-override]  # 3.12's
        """Perform the handshake; close the socket if it fails."""
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


class TlsFilesError(Exception):
    """The files of ``[mqtt.tls]`` cannot be used; the message names the file and the reason."""


def tls_context(tls: TlsSettings) -> ssl.SSLContext:
    """Return the context that verifies the broker and presents the daemon's certificate, if any.

    Raises
    ------
    TlsFilesError
        A file is missing, unreadable or not PEM, or key and certificate do not match.
    """
    for name, path in (("ca", tls.ca), ("cert", tls.cert), ("key", tls.key)):
        if path is not None:
            try:
                Path(path).read_bytes()
            except OSError as error:
                raise TlsFilesError(f"{name} = {path}: {error.strerror}") from error

    try:
        context = ssl.create_default_context(cafile=tls.ca)
    except ssl.SSLError as error:
        raise TlsFilesError(f"ca = {tls.ca}: contains no certificate in PEM") from error
    context.sslsocket_class = _ClosingTlsSocket
    context.minimum_version = ssl.TLSVersion.TLSv1_2

    if tls.cert is not None:
        try:
            # Without a passphrase function, OpenSSL would prompt on the terminal.
            context.load_cert_chain(tls.cert, tls.key, password=lambda: "")
        except (ssl.SSLError, ValueError) as error:
            files = f"cert = {tls.cert}, key = {tls.key or tls.cert}"
            raise TlsFilesError(
                f"{files}: expected a certificate and its own key, both in PEM, and the key "
                "without a passphrase"
            ) from error
    return context


def tls_remedy(
    error: BaseException | None, settings: MqttSettings, *, established: bool = False
) -> str:
    """Return cause and remedy of a failed TLS connection, in parentheses; empty if unknown.

    Parameters
    ----------
    error
        Exception that ended the connection.
    settings
        Table ``[mqtt]``.
    established
        Whether the client completed its part of the handshake. With TLS 1.3, the broker verifies
        the client's certificate only then. If the broker closes or resets the connection after
        that, it rejected the certificate. After a reset, the client does not receive the broker's
        alert.
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        return f" ({_verification_remedy(error, settings)})"
    if isinstance(error, ssl.SSLError) and "ALERT" in str(error.reason):
        if any(word in error.reason for word in _REJECTIONS):
            return f" ({_rejection_remedy(settings)})"
        return f" (the broker ended the handshake with the TLS alert {error.reason})"

    plain = isinstance(error, ssl.SSLError) and error.reason in _PLAIN_ANSWERS
    cut = isinstance(error, ssl.SSLEOFError | ConnectionResetError)
    if settings.tls is not None and cut and established:
        return f" ({_rejection_remedy(settings)})"
    if settings.tls is not None and (plain or cut):
        port = settings.tcp_port
        return f" (port {port} does not answer to TLS: set the port of the broker's TLS listener)"
    return ""


def _verification_remedy(error: ssl.SSLCertVerificationError, settings: MqttSettings) -> str:
    """Return cause and remedy if the verification of the broker's certificate failed."""
    code = error.verify_code
    trusted = (settings.tls.ca if settings.tls else None) or "the system's certificates"
    if code == _EXPIRED:
        return "the broker's certificate has expired: renew it, or set this machine's clock"
    if code == _NOT_YET_VALID:
        return "the broker's certificate is not valid yet: check this machine's clock"
    if code in {_OTHER_NAME, _OTHER_ADDRESS}:
        return (
            f"the broker's certificate is for another name than {settings.host}: set host to a "
            "name in the certificate, or issue a certificate that contains this host name "
            "(subjectAltName)"
        )
    if code in _UNTRUSTED:
        return (
            f"the broker's certificate is not signed by an authority in {trusted}: set [mqtt.tls] "
            "ca to the certificate of the broker's authority"
        )
    return f"the broker's certificate is not valid: {error.verify_message}: issue another one"


def _rejection_remedy(settings: MqttSettings) -> str:
    """Return cause and remedy if the broker rejected the client's certificate."""
    if settings.tls is None or settings.tls.cert is None:
        return "the broker requires a client certificate: set cert and key in [mqtt.tls]"
    return (
        f"the broker does not accept {settings.tls.cert}: check that it has not expired, and that "
        "the broker's cafile contains the authority that signed it"
    )
