"""Registers, stack and shared memory of a kernel, read from its cubin: no driver and no tool of CUDA's is needed.

A cubin is an ELF file; ``.nv.info`` holds what a driver has to know, as attributes whose numbers are those that
``cuobjdump -res-usage`` prints.
"""

from __future__ import annotations

import ast
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

_SIZED, _REGISTERS, _FRAME = 4, 0x2F, 0x11  # form of an attribute with a size; EIATTR_REGCOUNT, EIATTR_FRAME_SIZE


@dataclass(frozen=True)
class Resources:
    """Of one kernel: registers a thread, bytes of stack a thread, of shared memory a block, and of code."""

    registers: int
    stack: int
    shared: int
    code: int


def _sections(data: bytes) -> dict[str, bytes]:
    """The sections of a 64-bit ELF file, by name; of those without content in the file, as many zeros."""
    if data[:5] != b"\x7fELF\x02":
        raise ValueError("no 64-bit ELF file")
    (start,) = struct.unpack_from("<Q", data, 0x28)
    each, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQ", data, start + each * i) for i in range(count)]
    texts = data[headers[names][4] : headers[names][4] + headers[names][5]]
    found = {}
    for name, kind, _, _, offset, size in headers:
        title = texts[name : texts.index(b"\0", name)].decode()
        found[title] = b"\0" * size if kind == 8 else data[offset : offset + size]  # 8: SHT_NOBITS
    return found


def _attributes(info: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at + 4 <= len(info):
        form, kind, size = struct.unpack_from("<BBH", info, at)
        content = info[at + 4 : at + 4 + size] if form == _SIZED else b""
        found.append((kind, content))
        at += 4 + len(content)
    return found


def read_resources(cubin: Path) -> Resources:
    """Of the kernel in a cubin; of registers and stack the most that it or a function it calls takes.

    Raises:
        ValueError: it is no cubin of a kernel.
    """
    sections = _sections(cubin.read_bytes())
    numbers: dict[int, list[int]] = {_REGISTERS: [], _FRAME: []}
    for kind, content in _attributes(sections.get(".nv.info", b"")):
        if kind in numbers:
            numbers[kind].append(struct.unpack("<II", content)[1])  # of which symbol, and how much
    code = [len(content) for name, content in sections.items() if name.startswith(".text.")]
    if not numbers[_REGISTERS] or not code:
        raise ValueError(f"{cubin}: no kernel in it")
    shared = sum(len(content) for name, content in sections.items() if name.startswith(".nv.shared."))
    for meta in cubin.parent.glob("*.meta"):  # what Warp asks for at a launch
        shared += max(
            (int(n) for key, n in ast.literal_eval(meta.read_text()).items() if key.endswith("_smem_bytes")), default=0
        )
    return Resources(max(numbers[_REGISTERS]), sum(numbers[_FRAME]), shared, sum(code))


def compile_kernel(kernel: Any, arch: int, block: int, folder: Path) -> Path:
    """The cubin of a kernel that is alone in its module, for blocks of so many threads; in ``folder``, which is
    empty."""
    folder.mkdir(parents=True, exist_ok=True)
    kernel.module.options["block_dim"] = block
    wp.compile_aot_module(kernel.module, arch=arch, module_dir=folder, use_ptx=False)
    (cubin,) = folder.glob("*.cubin")
    return cubin
