"""X.509 certificates of a network's authority, and of those whom it knows."""

import ipaddress
import secrets
from collections.abc import Sequence
from datetime import datetime, timedelta

from ldo_service.errors import ConfigError

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise ConfigError(
        "making keys needs the extra `keys`: `pip install 'ldo-slam[keys]'` brings it."
    ) from error

MAX_DAYS = 36500
CLOCKS_DIFFER = timedelta(hours=1)  # of machines: a certificate is valid so long before it is made

PrivateKey = ec.EllipticCurvePrivateKey
Certificate = x509.Certificate


def new_key() -> PrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def of_authority(key: PrivateKey, days: int, now: datetime) -> Certificate:
    """Signed by itself. Raises ConfigError for a number of days that is none."""
    name = _named(f"ldo-slam {secrets.token_hex(4)}")  # two authorities are told apart
    public = key.public_key()
    return (
        _valid(name, name, public, days, now)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_keys=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .sign(key, hashes.SHA256())
    )


def of_member(
    authority: Certificate,
    signing: PrivateKey,
    common_name: str,
    public: ec.EllipticCurvePublicKey,
    days: int,
    now: datetime,
    hosts: Sequence[str] = (),
) -> Certificate:
    """For a client; with `hosts`, where others reach it, for a server too.

    Raises ConfigError for a host or a number of days that is none.
    """
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(signing.public_key())
    builder = (
        _valid(_named(common_name), authority.subject, public, days, now)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_keys=False), critical=True)
        .add_extension(issuer, critical=False)
    )
    if hosts:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        reached = x509.SubjectAlternativeName([_host(host) for host in dict.fromkeys(hosts)])
        builder = builder.add_extension(reached, critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    return builder.sign(signing, hashes.SHA256())


def certificate_pem(certificate: Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_pem(key: PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def read_certificate(body: bytes) -> Certificate:
    """Raises ValueError."""
    return x509.load_pem_x509_certificate(body)


def read_key(body: bytes) -> PrivateKey:
    """Raises ValueError."""
    key = serialization.load_pem_private_key(body, None)
    if not isinstance(key, PrivateKey):
        raise ValueError("it is no key of an elliptic curve")
    return key


def _valid(
    subject: x509.Name,
    issuer: x509.Name,
    public: ec.EllipticCurvePublicKey,
    days: int,
    now: datetime,
) -> x509.CertificateBuilder:
    if not 1 <= days <= MAX_DAYS:
        raise ConfigError(f"--days {days}: keys are valid for 1 to {MAX_DAYS} days.")
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_DIFFER)
        .not_valid_after(now + timedelta(days=days))
    )


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(signs_keys: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_keys,
        key_cert_sign=signs_keys,
        crl_sign=signs_keys,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise ConfigError(f"--host {host}: write a name in ASCII, or an address.") from error
