"""The self-signed certificate with which the page is served to other computers."""

from __future__ import annotations

import datetime
import ipaddress
import os
import socket
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.files import write_atomically
from nodes.linking.keys import default_folder

_VALID_DAYS = 825  # browsers refuse longer ones
_RENEW_DAYS = 30


@dataclass(frozen=True)
class Certificate:
    """A certificate with its key.

    Attributes:
        file: PEM file of the certificate.
        key_file: PEM file of the key, mode 0600.
        fingerprint: SHA-256 of the certificate, as browsers show it.
    """

    file: Path
    key_file: Path
    fingerprint: str


def page_folder() -> Path:
    """Folder of this user's certificate, beside the keys of the link."""
    return default_folder().with_name("page")


def certificate(folder: Path | None = None) -> Certificate:
    """Return the certificate of this user. It is made at the first use, and again a month before it expires."""
    folder = page_folder() if folder is None else folder
    file, key_file = folder / "certificate.pem", folder / "key.pem"
    if not _is_valid(file, key_file):
        _make(file, key_file)
    return Certificate(file, key_file, _fingerprint(file.read_bytes()))


def _is_valid(file: Path, key_file: Path) -> bool:
    from cryptography import x509

    if not (file.exists() and key_file.exists()):
        return False
    now = datetime.datetime.now(datetime.timezone.utc)
    known = x509.load_pem_x509_certificate(file.read_bytes())
    return known.not_valid_after_utc - now > datetime.timedelta(days=_RENEW_DAYS)


def _make(file: Path, key_file: Path) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"advnerf on {socket.gethostname()}"[:64])])
    now = datetime.datetime.now(datetime.timezone.utc)
    names = [
        x509.DNSName(each) for each in ("localhost", socket.gethostname(), f"{socket.gethostname()}.local")
    ]
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=_VALID_DAYS))
        .add_extension(
            x509.SubjectAlternativeName([*names, x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    )
    signed = builder.sign(key, hashes.SHA256())
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    file.parent.chmod(0o700)
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    descriptor = os.open(key_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(pem)
    write_atomically(file, signed.public_bytes(serialization.Encoding.PEM))


def _fingerprint(pem: bytes) -> str:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    digest = x509.load_pem_x509_certificate(pem).fingerprint(hashes.SHA256())
    return ":".join(f"{byte:02X}" for byte in digest)
