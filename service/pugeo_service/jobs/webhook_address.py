# SPDX-License-Identifier: Apache-2.0
"""Addresses of webhooks: http(s) URLs that lead to the public internet, unless others are allowed.

A service that sends requests to any URL could be used to reach machines behind its firewall.
"""

import asyncio
import ipaddress
import socket
from urllib.parse import SplitResult, urlsplit

from pugeo_service.problems import ProblemError

__all__ = ["ForbiddenAddressError", "check_url", "resolve"]

_PORTS = {"http": 80, "https": 443}
# Of NAT64: an IPv4 address, which may be private, inside an IPv6 address.
_TRANSLATED = ipaddress.ip_network("64:ff9b::/96")


class ForbiddenAddressError(Exception):
    """The host of a webhook has no address, or one that is not public."""


def check_url(url: str, *, private: bool) -> None:
    """Refuse a URL that no webhook can be sent to.

    Args:
        url: given by the client.
        private: whether addresses that are not public are allowed.

    Raises:
        ProblemError: 422 ``bad_option``, with the reason.
    """
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError:
        raise _refused("is not a URL") from None
    if parts.scheme not in _PORTS or not parts.hostname:
        raise _refused("must be http://HOST/PATH or https://HOST/PATH")
    if parts.username is not None or parts.password is not None:
        raise _refused("must not contain a name or password; the signature proves the sender")
    if any(not 0x21 <= ord(letter) <= 0x7E for letter in url):
        raise _refused("must be printable ASCII without spaces; encode other characters")
    try:
        address = ipaddress.ip_address(parts.hostname)
    except ValueError:
        return  # a name, which is looked up when the webhook is sent
    if not private and not _is_public(address):
        raise _refused(f"leads to {address}, which is not a public address")


async def resolve(parts: SplitResult, *, private: bool) -> tuple[str, int]:
    """Return an address and a port of the host of a URL.

    The webhook is sent to this address: a second look-up of the name might give another one.

    Raises:
        ForbiddenAddressError: the host has no address, or one that is not public.
    """
    host, port = parts.hostname or "", parts.port or _PORTS[parts.scheme]
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise ForbiddenAddressError(f"the host {host} is not known") from None
    addresses = [str(each[4][0]).partition("%")[0] for each in found]
    if not private:
        for address in addresses:
            if not _is_public(ipaddress.ip_address(address)):
                raise ForbiddenAddressError(
                    f"the host {host} leads to {address}, which is not a public address"
                )
    return addresses[0], port


def _is_public(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    if isinstance(address, ipaddress.IPv6Address):
        inner = address.ipv4_mapped or address.sixtofour
        if inner is not None:
            return _is_public(inner)
        if address in _TRANSLATED or address.teredo is not None:
            return False
    return address.is_global and not address.is_multicast


def _refused(reason: str) -> ProblemError:
    fields = {"parameter": "webhook"}
    return ProblemError(422, "bad_option", f"webhook {reason}.", fields=fields)
