"""Ways to spoil a file: bytes of any format, and the structure of those that have one."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from random import Random
from typing import Any

import numpy as np
import yaml

Mutation = Callable[[bytes, Random], bytes]

_NUMBERS = (
    *(0, 1, -1, 2, 255, 256, 65535, 2**31 - 1, 2**31, -(2**31), 2**32 - 1),
    *(2**40, 2**53 + 1, 2**63 - 1, 2**64 - 1, 10**30),
)
_ELSEWHERE = ("/etc/passwd", "http://127.0.0.1:9/x", "${oc.env:HOME}")
_WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "4294967295", "99999999999999999999999", "1e38", "-1e300", "0x10"),
    *("", " ", "\t", "a" * 3000, "../../../../etc/passwd", *_ELSEWHERE, "\x00", "\u202e", "ÿ", "%s%n", "--"),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, [], {}, [[]], [{}], "", "text", 0, 1, -1, 1.5),
    *(float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e-300),
    *(2**31, -(2**31), 2**63, 10**30, 10**400, -(10**400), "nan", "1e400", "1"),
    *([0] * 1000, [[1, 2], [3]], ["a", None], {"a": {"b": []}}, "../../outside", *_ELSEWHERE),
    *("${.}", "a" * 5000, "\x00", "é\ud800", [[[[[[[[1]]]]]]]]),
)


# ---------------------------------------------------------------- any file


def bytes_of(raw: bytes, rng: Random) -> bytes:
    """Flip bits, cut, insert, repeat, delete, or write an absurd number; up to four times, mostly near the front."""
    data = bytearray(raw)
    for _ in range(rng.randint(1, 4)):
        reach = len(data) if rng.random() < 0.5 else min(len(data), 400)
        at, size = rng.randrange(max(reach, 1)), rng.choice((1, 2, 4, 8))
        how = rng.randrange(7)
        if how == 0:
            del data[at:]
        elif how == 1:
            data[at:at] = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * 16))
        elif how == 2:
            data[at : at + size] = b"\xff" * size
        elif how == 3:
            number = rng.choice((*_NUMBERS[:-1], len(raw), len(raw) + 1))
            data[at : at + size] = (number % 2 ** (8 * size)).to_bytes(size, rng.choice(("little", "big")))
        elif how == 4:
            data[at:at] = data[at : at + rng.choice((1, 16, 200))]
        elif how == 5:
            del data[at : at + size]
        elif data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
    return bytes(data)


def lies(*reach: int) -> Mutation:
    """Absurd numbers in a binary header: at a place of ``range(*reach)``, 1 to 8 bytes in either order, or a float that
    is none."""

    def mutate(raw: bytes, rng: Random) -> bytes:
        data, places = bytearray(raw), range(*reach)
        for _ in range(rng.randint(1, 2)):
            at = rng.choice(places) % max(len(raw), 1)
            size, order = rng.choice((1, 2, 4, 8)), rng.choice(("<", ">"))
            if rng.random() < 0.2:
                data[at : at + 4] = struct.pack(f"{order}f", rng.choice((float("nan"), float("inf"), -1e38, 1e38)))
            else:
                number = rng.choice((*_NUMBERS[:-1], len(raw), len(raw) - at, rng.randrange(2**16)))
                data[at : at + size] = (number % 2 ** (8 * size)).to_bytes(size, "little" if order == "<" else "big")
        return bytes(data)

    return mutate


def text_of(raw: bytes, rng: Random) -> bytes:
    """Replace, repeat, drop or exchange words and lines of a text; what follows a header that ends in ``end_header`` is
    left."""
    head, mark, body = raw.partition(b"end_header\n")
    text = head.decode("utf-8", "surrogateescape")
    lines = [[""], *(re.split(r"(\s+|[=,()\"]+)", line) for line in text.split("\n"))]
    for _ in range(rng.randint(1, 3)):
        line = rng.choice(lines[1:] or lines)
        at, how = rng.randrange(max(len(line), 1)), rng.randrange(6)
        line = line or [""]
        if how < 3:
            at -= at % 2
            line[at] = rng.choice(_WORDS) if how < 2 else rng.choice(rng.choice(lines) or [""])
        elif how == 3:
            lines.insert(rng.randrange(1, len(lines) + 1), [*line] * rng.choice((1, 1, 50)))
        elif how == 4 and len(lines) > 2 and line in lines:
            lines.remove(line)
        else:
            del line[at:]
    return "\n".join("".join(line) for line in lines[1:]).encode("utf-8", "surrogateescape") + mark + body


# ---------------------------------------------------------------- documents


def _document(value: Any, rng: Random) -> Any:
    """A tree of lists and dictionaries with one to three of its nodes replaced, dropped, repeated, moved or wrapped."""
    root = [value]
    for _ in range(rng.randint(1, 3)):
        nodes = list(_nodes(root))
        holder, key = rng.choice(nodes)
        how = rng.randrange(8)
        if how == 0 and holder is not root:
            del holder[key]
        elif how == 1 and isinstance(holder, list) and holder is not root:
            holder.insert(key, holder[key])
        elif how == 2:
            holder[key] = rng.choice(([holder[key]], {"a": holder[key]}, str(holder[key])[:200]))
        elif how == 3 and isinstance(holder, dict):
            name = rng.choice(("", "x" * 300, "file_path", "__class__", str(key).upper()))
            holder[name] = rng.choice((holder.pop(key), deepcopy(rng.choice(_VALUES))))
        elif how == 4:
            other, name = rng.choice(nodes)
            if name in (range(len(other)) if isinstance(other, list) else other) and other is not root:
                holder[key] = json.loads(json.dumps(other[name]))
        else:
            holder[key] = deepcopy(rng.choice(_VALUES))
    return root[0]


def _nodes(root: list[Any] | dict[Any, Any], depth: int = 0) -> Any:
    for key in list(root) if isinstance(root, dict) else range(len(root)):
        yield root, key
        if isinstance(root[key], list | dict) and depth < 12:
            yield from _nodes(root[key], depth + 1)


def _dumped(value: Any, rng: Random) -> bytes:
    """JSON of Python's kind (NaN and Infinity), now and then with a number beyond float64, a key twice or what is no
    JSON at all."""
    text = json.dumps(value)
    if rng.random() < 0.15:
        beyond = ("1e400", "-1e400", "9" * 5000)
        text = re.sub(r"\d+\.?\d*", lambda m: rng.choice((m[0], m[0], *beyond)), text, count=rng.randint(1, 6))
    if rng.random() < 0.05:
        text = re.sub(r'("\w+"): ', r"\1: 7, \1: ", text, count=1)
    if rng.random() < 0.03:
        text = rng.choice(("[" * 100_000, '{"a":' * 50_000, "\ufeff" + text, text + "]", "", "null"))
    return text.encode("utf-8", "surrogatepass")


def json_of(raw: bytes, rng: Random) -> bytes:
    return _dumped(_document(json.loads(raw), rng), rng)


def jsonl_of(raw: bytes, rng: Random) -> bytes:
    lines = raw.splitlines()
    at = rng.randrange(len(lines))
    lines[at] = json_of(lines[at], rng)
    return b"\n".join(lines)


def yaml_of(raw: bytes, rng: Random) -> bytes:
    """As JSON, and what only YAML has: aliases that grow, tags, dates, several documents."""
    if rng.random() < 0.2:
        key = rng.choice(re.findall(rb"^(\w+):", raw, re.MULTILINE))
        bomb = b"a: &a [1,1,1,1,1,1,1,1,1]\n" + b"".join(
            b"%c: &%c [%s]\n" % (c, c, b",".join([b"*%c" % (c - 1)] * 9)) for c in range(98, 107)
        )
        tags = (b"&x [*x]", b"!!python/object/apply:os.system ['false']", b"2001-01-01", b"!!binary aGk=")
        value = rng.choice((*tags, b"{[1]: 2}", b"? [a]\n", b"1:30", b"0o777"))
        if rng.random() < 0.3:
            return raw + bomb + key + b": *j\n"
        return re.sub(rb"^%s:.*(\n[ -].*)*" % key, lambda m: key + b": " + value, raw, count=1, flags=re.MULTILINE)
    value = _document(yaml.safe_load(raw), rng)
    text: str = yaml.safe_dump(json.loads(json.dumps(value).replace("\\ud800", "?")), allow_unicode=True)
    return text.encode()


# ---------------------------------------------------------------- containers


def safetensors(raw: bytes, rng: Random) -> bytes:
    """Of the table of tensors, or of neuprim's own header inside its metadata."""
    size = int.from_bytes(raw[:8], "little")
    header = json.loads(raw[8 : 8 + size])
    inner = header.get("__metadata__", {}).get("neuprim")
    if inner is not None and rng.random() < 0.6:
        header["__metadata__"]["neuprim"] = _dumped(_document(json.loads(inner), rng), rng).decode("utf-8", "replace")
        text = json.dumps(header).encode()
    else:
        text = _dumped(_document(header, rng), rng)
    return len(text).to_bytes(8, "little") + text + raw[8 + size :]


def compressed(raw: bytes, rng: Random) -> bytes:
    """Of the header of a compressed model, or of its table of sections; the check sum is right."""
    version, sections, count, text_size, table_size, _ = struct.unpack_from("<IIQIII", raw, 8)
    text, table = raw[36 : 36 + text_size], raw[36 + text_size : 36 + text_size + table_size]
    if rng.random() < 0.5:
        text = _dumped(_document(json.loads(text), rng), rng)
    else:
        table = lies(0, len(table))(table, rng)
    if rng.random() < 0.2:
        count = rng.choice((0, 1, count + 1, 2**31, 2**40))
    start = struct.pack("<IIQII", version, sections, count, len(text), len(table))
    body = raw[36 + text_size + table_size :]
    return raw[:8] + start + struct.pack("<I", zlib.crc32(start + text + table)) + text + table + body


def gzipped(raw: bytes, rng: Random) -> bytes:
    """Of the first 40 bytes inside a gzip stream; the check sum is right."""
    return gzip.compress(lies(0, 40)(gzip.decompress(raw), rng))


def glb(raw: bytes, rng: Random) -> bytes:
    size = int.from_bytes(raw[12:16], "little")
    text = _dumped(_document(json.loads(raw[20 : 20 + size]), rng), rng)
    text += b" " * (-len(text) % 4)
    rest = raw[20 + size :]
    return raw[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def png(raw: bytes, rng: Random) -> bytes:
    """Fields of the header, contents of chunks, chunks twice or missing; check sums are right."""
    chunks, at = [], 8
    while at < len(raw):
        size = int.from_bytes(raw[at : at + 4], "big")
        chunks.append((raw[at + 4 : at + 8], raw[at + 8 : at + 8 + size]))
        at += 12 + size
    for _ in range(rng.randint(1, 2)):
        index = rng.randrange(len(chunks)) if rng.random() < 0.5 else 0
        kind, content = chunks[index]
        how = rng.randrange(5)
        if how == 0 and len(chunks) > 1:
            del chunks[index]
        elif how == 1:
            other = rng.choice((kind, b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"eXIf"))
            chunks.insert(rng.randrange(len(chunks)), (other, content))
        elif how == 2:
            chunks[index] = (kind, zlib.compress(bytes(rng.choice((1, 10**6, 10**8))), 9))
        else:
            chunks[index] = (kind, lies(0, max(len(content), 1))(content, rng))
    return raw[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def npz(raw: bytes, rng: Random) -> bytes:
    """Headers of the arrays inside, arrays of other kinds and sizes, arrays missing, and zip tricks."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, made = rng.choice(list(members)), io.BytesIO()
    how = rng.randrange(5)
    if how == 0:
        del members[name]
    elif how == 1:
        arrays = (np.zeros(0), np.array(["a"]), np.zeros((2, 2, 2)), np.full(5, np.nan), np.zeros(3, ">f8"))
        np.lib.format.write_array(made, rng.choice(arrays))
        members[name] = made.getvalue()
    elif how == 2:
        members[name] = text_of(members[name][:128], rng)[:128].ljust(128) + members[name][128:]
    else:
        members[name] = bytes_of(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if rng.random() < 0.2 else zipfile.ZIP_STORED) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return lies(0, len(out.getvalue()))(out.getvalue(), rng) if rng.random() < 0.3 else out.getvalue()
