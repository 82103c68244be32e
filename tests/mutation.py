"""Seeded damage to files."""

from __future__ import annotations

import random
import re

WORDS = re.compile(rb"[A-Za-z_.\-0-9]+|[\[\]{}:,#\n]")

# What breaks readers: values at and beyond the edge, YAML that a scene has no use for, bytes that are no text.
TOKENS = [
    *(b"null", b"~", b"true", b"0", b"-1", b"4096", b"4097", b"1000000000000", b"png", b"oblique", b"auto"),
    *(b"1e999", b"-1e999", b".nan", b".inf", b"-.inf", b"1e-320", b"1e308", b"1_000", b"0o17"),
    *(b"1:30:00", b"2001-01-01"),
    *(b"9" * 5000, b"0x" + b"f" * 300, b"[" * 3000, b"/etc/passwd", b"../x.png"),
    *(b"[", b"]", b"{", b"}", b"? ", b"- ", b": ", b"#", b"|", b">", b"'", b'"', b"\\", b"@", b"`", b"\t"),
    *(b"&a", b"*a", b"<<: *a", b"!x", b"!!python/object/apply:os.system [id]", b"---", b"...", b"%YAML 1.2"),
    *(b"\x00", b"\x7f", b"\xff\xfe", b"\xef\xbb\xbf", b"\r\n", b"\r", b"\xe2\x80\xa8", b"\xf0\x9f\xa7\xa0"),
]


def damaged_text(rng: random.Random, data: bytes) -> bytes:
    """Change, add, drop or repeat a few bytes or words."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at, other = sorted(rng.randrange(len(changed) + 1) for _ in range(2))
        kind = rng.choice(("byte", "token", "word", "word", "drop", "repeat", "cut"))
        if kind == "byte":
            changed[at : at + rng.randrange(2)] = bytes([rng.randrange(256)])
        elif kind == "token":
            changed[at:at] = rng.choice(TOKENS)
        elif kind == "word" and (words := list(WORDS.finditer(bytes(changed)))):
            word = rng.choice(words)
            new = rng.choice(TOKENS) if rng.random() < 0.5 else rng.choice(words).group()
            changed[word.start() : word.end()] = new
        elif kind == "drop":
            del changed[at : at + rng.choice((1, 2, 5, 40))]
        elif kind == "repeat":
            changed[at:at] = changed[at : min(other, at + 200)]
        elif kind == "cut":
            del changed[at:]
    return bytes(changed)


def damaged_picture(rng: random.Random, data: bytes) -> bytes:
    """Change, add or drop a few bytes or numbers, or cut the end off."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 10))):
        at = rng.randrange(len(changed) + 1)
        kind = rng.choice(("byte", "number", "drop", "add"))
        if kind == "byte":
            changed[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == "number":
            changed[at : at + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\0\0\xff\xff"))
        elif kind == "drop":
            del changed[at : at + rng.choice((1, 4, len(changed)))]
        else:
            changed[at:at] = rng.randbytes(4)
    return bytes(changed)
