# SPDX-License-Identifier: Apache-2.0
"""The HTTP library (httpx2, or its predecessor httpx), and its errors as those of this package."""

import contextlib
import ssl
from collections.abc import Iterator

from pugeo_client.errors import ConfigurationError, ConnectionFailedError, PugeoError

# httpx is no longer developed and httpx2 keeps its interface; some environments pin httpx.
try:
    import httpx2 as httpx
except ImportError:
    import httpx  # type: ignore[no-redef, import-not-found, unused-ignore]

__all__ = ["HTTP_ERRORS", "checked_url", "configuration_errors", "httpx", "to_package_error"]

HTTP_ERRORS = (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError, UnicodeError)
"""Everything that a request may raise; the last one for a host name that IDNA cannot encode."""


def checked_url(url: str) -> str:
    """Return the URL without a trailing slash.

    Raises:
        ConfigurationError: it is no http or https URL with a host.
    """
    try:
        parsed = httpx.URL(url)
        parsed.host.encode("idna")
    except (httpx.InvalidURL, UnicodeError, TypeError) as error:
        raise ConfigurationError(f"the base URL cannot be used: {error}") from error
    if parsed.scheme not in {"http", "https"} or not parsed.host:
        raise ConfigurationError(
            f"the base URL must look like http://127.0.0.1:8000, not {without_password(url)!r}"
        )
    return url.rstrip("/")


def without_password(url: str) -> str:
    """Return a URL for messages: without user and password."""
    scheme, mark, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{mark}{authority.rpartition('@')[2]}{slash}{path}" if mark else url


@contextlib.contextmanager
def configuration_errors() -> Iterator[None]:
    """Turn the errors of making an HTTP client into ConfigurationError."""
    try:
        yield
    except (ValueError, ImportError, OSError, httpx.InvalidURL) as error:
        raise ConfigurationError(
            f"the HTTP client cannot be set up: {error} (check the proxies in HTTP_PROXY, "
            "HTTPS_PROXY and ALL_PROXY, and the certificates in SSL_CERT_FILE and SSL_CERT_DIR)"
        ) from error


def to_package_error(error: Exception, url: str) -> PugeoError:
    """Turn an error of `HTTP_ERRORS` into one of this package.

    Args:
        error: raised by the HTTP library.
        url: address of the service, for the message.
    """
    shown = without_password(url)
    if isinstance(error, (httpx.LocalProtocolError, httpx.UnsupportedProtocol, httpx.InvalidURL)):
        return PugeoError(f"the request cannot be sent: {error}")
    if isinstance(error, UnicodeError):
        return ConfigurationError(f"{shown} has no valid host name")
    if _distrusts(error):
        return ConfigurationError(
            f"the certificate of {shown} is not trusted: {error} (name the file of its authority "
            "in SSL_CERT_FILE, or pass http_client=)"
        )
    reason = f"{type(error).__name__}: {error}".rstrip(": ")
    if isinstance(error, httpx.ConnectError):
        return ConnectionFailedError(
            f"nothing answers at {shown} ({reason}); start a service with `pugeo serve`, or name "
            "the address of one in base_url= or PUGEO_URL"
        )
    if isinstance(error, httpx.ProxyError):
        return ConnectionFailedError(f"the proxy does not connect to {shown} ({reason})")
    return ConnectionFailedError(f"no complete answer from {shown} ({reason})")


def _distrusts(error: BaseException | None) -> bool:
    """Tell whether a certificate that failed its check is the cause of an error."""
    while error is not None:
        if isinstance(error, ssl.SSLCertVerificationError):
            return True
        error = error.__cause__ or error.__context__
    return False
