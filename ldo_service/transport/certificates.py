"""X.509 certificates of a network's authority and its members."""

import ipaddress
import secrets
from collections.abc import Sequence
from datetime import datetime, timedelta

from ldo_service.errors import ConfigError, install_command

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise ConfigError(
        f"creating keys needs the extra `keys`. Install it by {install_command('keys')}."
    ) from error

MAX_DAYS = 36500  # Maximum validity of a certificate.
# Maximum difference between the clocks of machines. The validity of a certificate begins this
# long before its creation.
CLOCKS_DIFFER = timedelta(hours=1)

PrivateKey = ec.EllipticCurvePrivateKey
Certificate = x509.Certificate


def new_key() -> PrivateKey:
    """Generate a private key on the curve P-256."""
    return ec.generate_private_key(ec.SECP256R1())


def of_authority(key: PrivateKey, days: int, now: datetime) -> Certificate:
    """Create the self-signed certificate of an authority.

    Args:
        key: Private key of the authority.
        days: Validity, days.
        now: Current time.

    Raises:
        ConfigError: The number of days is out of range.
    """
    name = _named(f"ldo-slam {secrets.token_hex(4)}")  # The random number is unique.
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
    """Create the certificate of a member of the network.

    Every member is a client. A member with hosts is also a server.

    Args:
        authority: Certificate of the authority.
        signing: Private key of the authority.
        common_name: Common name of the member.
        public: Public key of the member.
        days: Validity, days.
        now: Current time.
        hosts: Host names and IP addresses of a server; empty for a client.

    Raises:
        ConfigError: A host or the number of days is invalid.
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
    """Encode a certificate as PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_pem(key: PrivateKey) -> bytes:
    """Encode a private key as PEM, without encryption."""
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def read_certificate(body: bytes) -> Certificate:
    """Read a certificate from PEM.

    Raises:
        ValueError: The bytes are no certificate.
    """
    return x509.load_pem_x509_certificate(body)


def read_key(body: bytes) -> PrivateKey:
    """Read a private key from PEM.

    Raises:
        ValueError: The bytes are no private key of an elliptic curve.
    """
    key = serialization.load_pem_private_key(body, None)
    if not isinstance(key, PrivateKey):
        raise ValueError("the key must be a private key of an elliptic curve")
    return key


def _valid(
    subject: x509.Name,
    issuer: x509.Name,
    public: ec.EllipticCurvePublicKey,
    days: int,
    now: datetime,
) -> x509.CertificateBuilder:
    if not 1 <= days <= MAX_DAYS:
        raise ConfigError(f"--days {days} must be within 1..{MAX_DAYS}.")
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
        raise ConfigError(
            f"--host {host} must be a host name in ASCII or an IP address."
        ) from error
