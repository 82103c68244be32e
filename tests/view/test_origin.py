"""Origins of pages, as browsers compare them: equal scheme, host and port."""

from __future__ import annotations

import pytest

from taichi_msm.view.origin import parse_origin


@pytest.mark.parametrize(
    ("spellings", "others"),
    [
        (
            "https://hub.org https://hub.org:443 https://hub.org/ HTTPS://Hub.ORG https://hub.org:0443 https://hub.org:",
            "http://hub.org https://hub.org:80 https://hub.org:444 https://hub.org. https://www.hub.org",
        ),
        ("http://hub.org http://hub.org:80", "https://hub.org http://hub.org:443"),
        ("http://[::1]:8000 http://[0:0::1]:8000/", "http://[::1] http://[::2]:8000 http://127.0.0.1:8000"),
        ("http://my_host-2:1", "http://my_host-2:2"),
    ],
)
def test_equal_origins(spellings: str, others: str) -> None:
    (origin,) = {parse_origin(text) for text in spellings.split()}
    assert origin is not None
    assert origin not in {parse_origin(text) for text in others.split()}
    assert None not in {parse_origin(text) for text in others.split()}


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "null",
            "hub.org",
            "//hub.org",
            "https://",
            "https:///",
            "ftp://hub.org",
            "https:hub.org",
            "https://a..b",
        ),
        *("http://a b", " http://a", "http://a\n", "http://a\0", "http://\u00fc.org", "http://a,http://b", "http://.a"),
        *(
            "https://me@hub.org",
            "https://me:word@hub.org",
            "https://hub.org/user",
            "https://hub.org?",
            "https://hub.org#",
        ),
        *("http://[::1", "http://::1", "http://[]", "http://[::1]a", "http://[:::1]", "http://[fe80::1%25eth0]"),
        *("http://a:65536", "http://a:-1", "http://a:b", "http://a:8 0", "http://a:\u0663", "http://a:80:80"),
        *("http://" + "a." * 50_000 + "/x", "http://a:" + "9" * 50_000),
    ],
    ids=lambda text: text[:20],
)
def test_no_origins(text: str) -> None:
    assert parse_origin(text) is None
