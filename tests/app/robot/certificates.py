"""An authority of our own and certificates that it signed, made anew for a test."""

from __future__ import annotations

import datetime
import ipaddress
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_LIVES = datetime.timedelta(days=2)


class Authority:
    """Signs certificates and writes them, with their keys, into a folder.

    Args:
        folder: Where NAME.pem and NAME-key.pem go.
        name: Of the authority; its own certificate is NAME.pem.
    """

    def __init__(self, folder: Path, name: str = "ca") -> None:
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _named(name)
        self._write(
            name, self._built(self._name, self._key.public_key(), own=True).sign(self._key, hashes.SHA256())
        )

    def sign(self, name: str) -> None:
        """A certificate for a name, for this machine and for both ends of a connection."""
        key = ec.generate_private_key(ec.SECP256R1())
        here = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        built = (
            self._built(_named(name), key.public_key(), own=False)
            .add_extension(x509.SubjectAlternativeName(here), critical=False)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        )
        self._write(name, built.sign(self._key, hashes.SHA256()))
        secret = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        (self._folder / f"{name}-key.pem").write_bytes(secret)

    def _built(
        self, name: x509.Name, key: ec.EllipticCurvePublicKey, *, own: bool
    ) -> x509.CertificateBuilder:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _LIVES)
            .not_valid_after(now + _LIVES)
            .add_extension(x509.BasicConstraints(ca=own, path_length=None), critical=True)
        )

    def _write(self, name: str, certificate: x509.Certificate) -> None:
        (self._folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
