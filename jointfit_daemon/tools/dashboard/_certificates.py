"""TLS settings of the dashboard for the connections to browsers and to the broker.

Invariant: the certificate of the broker is always verified, and the TLS version is at least 1.2.
"""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.dashboard.addresses import BrokerAddress

# OpenSSL error numbers (X509_V_ERR_… in x509_vfy.h).
_NOT_YET_VALID, _EXPIRED = 9, 10
_OTHER_NAMES = (62, 64)


def broker_context(broker: BrokerAddress, authority: Path | None) -> ssl.SSLContext | None:
    """Return the TLS context that verifies the broker, or None for plain TCP.

    Raises
    ------
    ValueError
        `authority` contains no certificate, or the connection does not use TLS.
    OSError
        `authority` cannot be read.
    """
    if not broker.tls or broker.websocket is not None:
        if authority is not None:
            raise ValueError(f"--ca {authority}: expected a broker with TLS, such as mqtts://HOST")
        return None
    try:
        if authority is not None:
            authority.read_bytes()  # the error of ssl does not contain the path
        context = ssl.create_default_context(cafile=authority)
    except ssl.SSLError as error:
        raise ValueError(f"--ca {authority}: expected a certificate in PEM, found none") from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


def page_context(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """Return the TLS context that serves the page by HTTPS, or None for HTTP.

    Parameters
    ----------
    certificate
        Certificate of this machine in PEM format, with intermediate certificates if necessary.
    key
        Private key of the certificate; None if the certificate file contains the key.

    Raises
    ------
    ValueError
        The files are not a certificate and its key, or the key has a passphrase.
    OSError
        A file cannot be read.
    """
    if certificate is None:
        if key is not None:
            raise ValueError(f"--key {key}: expected --certificate with the certificate of the key")
        return None
    certificate.read_bytes()  # the errors of ssl do not contain the path
    if key is not None:
        key.read_bytes()

    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # Without a function for the passphrase, OpenSSL prompts on the terminal.
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, ValueError) as error:
        source = f"--certificate {certificate}" + ("" if key is None else f" --key {key}")
        raise ValueError(
            f"{source}: expected a certificate and its own private key, both in PEM, the key"
            " without a passphrase"
        ) from error
    return context


def verification_fault(error: ssl.SSLCertVerificationError) -> str:
    """Return cause and remedy of a failed verification of the broker's certificate."""
    if error.verify_code == _EXPIRED:
        return "its certificate has expired: renew it, or set this machine's clock"
    if error.verify_code == _NOT_YET_VALID:
        return "its certificate is not valid yet: set this machine's clock"
    if error.verify_code in _OTHER_NAMES:
        return "its certificate is for another name: correct --broker"
    return "its certificate is not signed by a known authority: set --ca"
