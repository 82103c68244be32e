"""Origins of pages: scheme, host and port."""

from __future__ import annotations

import re
from ipaddress import IPv6Address
from typing import NamedTuple

DEFAULT_PORTS = {"http": 80, "https": 443}

_ORIGIN = re.compile(r"(https?)://((?:[a-z0-9_-]+\.)*[a-z0-9_-]+\.?|\[[0-9a-f:.]{2,45}\])(?::([0-9]{0,5}))?/?")


class Origin(NamedTuple):
    """An origin; equal ones have equal attributes."""

    scheme: str
    host: str
    port: int


def parse_origin(text: str) -> Origin | None:
    """Parse an origin such as https://hub.example.org:8000; return None for other texts."""
    match = _ORIGIN.fullmatch(text.lower())
    if match is None:
        return None
    scheme, host, port = match[1], match[2], int(match[3] or DEFAULT_PORTS[match[1]])
    try:
        host = f"[{IPv6Address(host[1:-1])}]" if host.startswith("[") else host
    except ValueError:
        return None
    return Origin(scheme, host, port) if port < 2**16 else None
