# SPDX-License-Identifier: Apache-2.0
"""Make the certificates by which front, scheduler and workers know each other.

    python deploy/make_certs.py FOLDER

A Dask scheduler runs whatever it is sent, so every connection is encrypted and both ends show a
certificate of this authority. Whoever holds FOLDER can run code on the workers. It is made if it
is missing, and files that are there are kept.
"""

import datetime as dt
import sys
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

LIFETIME = dt.timedelta(days=825)


def main(folder: Path) -> None:
    """Write ``ca.pem``, ``cert.pem`` and ``key.pem``; the authority's own key is thrown away."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    files = [folder / name for name in ("ca.pem", "cert.pem", "key.pem")]
    if all(path.exists() for path in files):
        return
    authority_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    authority_name, name = _name("pugeo authority"), _name("pugeo cluster")
    authority = (
        _certificate(authority_name, authority_key.public_key(), authority_name)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(authority_key, hashes.SHA256())
    )
    certificate = (
        _certificate(name, key.public_key(), authority_name)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(authority_key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    private = key.private_bytes(
        pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    contents = (authority.public_bytes(pem), certificate.public_bytes(pem), private)
    for path, content in zip(files, contents, strict=True):
        path.touch(mode=0o600)
        path.write_bytes(content)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _certificate(
    subject: x509.Name, public_key: ec.EllipticCurvePublicKey, issuer: x509.Name
) -> x509.CertificateBuilder:
    now = dt.datetime.now(dt.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(minutes=5))
        .not_valid_after(now + LIFETIME)
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
