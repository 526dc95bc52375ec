"""Files spoiled on purpose, each by a seed: bytes, words and numbers of text, nodes of JSON, headers."""

import json
import re
from collections.abc import Callable
from random import Random
from typing import Any

NUMBERS = ("nan", "inf", "-inf", "0", "-1", "-0.0", "1e308", "1e-320", "4294967296", "9" * 25, "1e400",
           "0.1.2", "0x10", "2147483647", "-2147483648", "65536", "1e9")  # fmt: skip
VALUES = (None, True, -1, 0, 1e308, 1e-320, 2**31, 2**63, 2**70, "", "x" * 5000, "\x00", [], {}, [[]],
          float("nan"), float("inf"), {"a": 1}, [1, "a", None])  # fmt: skip
PATHS = ("../../canary{}", "../canary{}", "{root}/canary{}", "./link{}", "../link{}", "/etc/passwd",
         "/dev/zero", "/proc/self/environ", "file:///etc/passwd", "http://127.0.0.1:9/x{}", "", ".",
         "..", "~/x{}", "../../../../../../../../etc/passwd", "x" * 5000, "%2e%2e/canary{}",
         "a.usdz[../../canary{}]", "canary{}", "./case{}")  # fmt: skip
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][+-]?\d+)?")
ASSET = re.compile(rb"@([^@\n]*)@")
QUOTED = re.compile(rb'"([^"\n]*)"')
TARGET = re.compile(rb"<(/[^>\n]*)>")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9:]*")
Damage = Callable[[bytes, Random], bytes]


def flipped(data: bytes, draw: Random) -> bytes:
    spoiled = bytearray(data or b"\0")
    for _ in range(draw.choice([1, 1, 4, 64])):
        spoiled[draw.randrange(len(spoiled))] ^= 1 << draw.randrange(8)
    return bytes(spoiled)


def cut(data: bytes, draw: Random) -> bytes:
    return data[: draw.randrange(len(data) + 1)]


def lost(data: bytes, draw: Random) -> bytes:
    a, b = _span(data, draw)
    return data[:a] + data[b:]


def doubled(data: bytes, draw: Random) -> bytes:
    a, b = _span(data, draw)
    return data[:b] + data[a:b] * draw.choice([1, 1, 50]) + data[b:]


def swapped(data: bytes, draw: Random) -> bytes:
    (a, b), (c, d) = sorted([_span(data, draw), _span(data, draw)])
    if c < b:
        return data[:a] + data[a:b][::-1] + data[b:]
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def replaced(data: bytes, draw: Random) -> bytes:
    a, b = _span(data, draw)
    return data[:a] + draw.randbytes(min(b - a, 4096)) + data[b:]


def _span(data: bytes, draw: Random) -> tuple[int, int]:
    a = draw.randrange(len(data) + 1)
    return a, min(len(data), a + draw.choice([1, 4, 16, 200, 5000]))


BYTES: tuple[Damage, ...] = (flipped, cut, lost, doubled, swapped, replaced)


# text


def _in_place(
    data: bytes, draw: Random, pattern: re.Pattern[bytes], new: Callable[[], str]
) -> bytes:
    """One to four of the places that a pattern finds, replaced."""
    for _ in range(draw.choice([1, 1, 4])):
        found = list(pattern.finditer(data))
        if not found:
            return flipped(data, draw)
        match = draw.choice(found)
        a, b = match.span(1 if pattern.groups else 0)
        data = data[:a] + new().encode() + data[b:]
    return data


def other_numbers(data: bytes, draw: Random) -> bytes:
    return _in_place(data, draw, NUMBER, lambda: draw.choice(NUMBERS))


def other_words(data: bytes, draw: Random) -> bytes:
    words = [m[0].decode() for m in WORD.finditer(data)] or ["x"]
    return _in_place(data, draw, WORD, lambda: draw.choice(words))


def other_targets(data: bytes, draw: Random) -> bytes:
    known = [m[1].decode() for m in TARGET.finditer(data)] or ["/"]
    odd = ["/", "/World", "", "../..", "/World.x", "/" + "a/" * 2000 + "b"]
    return _in_place(data, draw, TARGET, lambda: draw.choice(known + odd))


def other_strings(data: bytes, draw: Random) -> bytes:
    odd = ["", "\\", "\x00", "x" * 5000, "%s%n", "\x1b[2J", "\u202e", "../..", "nan"]
    return _in_place(data, draw, QUOTED, lambda: draw.choice(odd))


def lines(data: bytes, draw: Random) -> bytes:
    """Lines lost, doubled or put elsewhere."""
    rows = data.split(b"\n")
    for _ in range(draw.choice([1, 3])):
        row = rows.pop(draw.randrange(len(rows))) if len(rows) > 1 else b""
        for _ in range(draw.choice([0, 1, 2])):
            rows.insert(draw.randrange(len(rows) + 1), row)
    return b"\n".join(rows)


def paths(pattern: re.Pattern[bytes], root: str, ending: str) -> Damage:
    """Files named that may not be read."""

    def spoil(data: bytes, draw: Random) -> bytes:
        return _in_place(data, draw, pattern, lambda: hostile_path(draw, root, ending))

    return spoil


def hostile_path(draw: Random, root: str, ending: str) -> str:
    return draw.choice(PATHS).replace("{root}", root).replace("{}", ending)


TEXT: tuple[Damage, ...] = (other_numbers, other_words, lines, other_strings)


# JSON


def other_nodes(data: bytes, draw: Random) -> bytes:
    """One to three nodes of a JSON document replaced, lost, or under another key."""
    told = json.loads(data)
    for _ in range(draw.choice([1, 1, 3])):
        holder = draw.choice(list(_holders(told)))
        if not holder:
            continue
        key = draw.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        if isinstance(holder, dict) and draw.random() < 0.2:
            holder[draw.choice(["x", "__class__", key + "_"])] = holder.pop(key)
        elif draw.random() < 0.1:
            del holder[key]
        else:
            holder[key] = draw.choice(VALUES)
    text = json.dumps(told)
    if draw.random() < 0.05:
        text = text.replace("1", "[" * 5000, 1)
    return text.encode()


def _holders(node: Any):
    if isinstance(node, (dict, list)):
        yield node
        for inner in node.values() if isinstance(node, dict) else node:
            yield from _holders(inner)


# safetensors


def other_header(data: bytes, draw: Random) -> bytes:
    """The header of a safetensors file, or the JSON within its metadata, spoiled, its length mended;
    or the length alone."""
    size = int.from_bytes(data[:8], "little")
    head, body = data[8 : 8 + size], data[8 + size :]
    if draw.random() < 0.15:
        return draw.choice([0, 1, size - 1, size + 1, 2**31, 2**63, len(data)]).to_bytes(
            8, "little"
        ) + (head + body)
    if draw.random() < 0.5:
        told = json.loads(head)
        name, inner = next(iter(told["__metadata__"].items()))
        told["__metadata__"][name] = other_nodes(inner.encode(), draw).decode()
        head = json.dumps(told).encode()
    else:
        head = draw.choice([other_nodes, other_nodes, other_numbers])(head, draw)
    return len(head).to_bytes(8, "little") + head + body


def other_tensors(data: bytes, draw: Random) -> bytes:
    """Numbers of the tensors: not finite, huge, or at random."""
    size = 8 + int.from_bytes(data[:8], "little")
    body = bytearray(data[size:])
    for _ in range(draw.choice([1, 10, 1000])):
        at = 4 * draw.randrange(max(1, len(body) // 4))
        body[at : at + 4] = draw.choice(
            [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", draw.randbytes(4)]
        )
    return data[:size] + bytes(body)
