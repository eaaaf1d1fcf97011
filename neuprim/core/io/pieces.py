"""Files of tensors that are written piece by piece, for whoever never has a whole tensor in memory.

The format is that of safetensors (https://github.com/huggingface/safetensors): the length of a header as eight bytes,
the header in JSON, then the tensors' bytes without gaps. The library writes whole tensors alone; it reads these files
as its own.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

__all__ = ["Kind", "in_order", "write_pieces"]

Kind = tuple[torch.dtype, tuple[int, ...]]
"""Type and shape of a tensor."""

_NAMES = {
    torch.float32: "F32",
    torch.float64: "F64",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}


def in_order(kinds: Mapping[str, Kind]) -> list[str]:
    """Names of tensors as a file has them: those of wide numbers first, so that all are aligned."""
    return sorted(kinds, key=lambda name: (-kinds[name][0].itemsize, name))


def write_pieces(
    path: Path, kinds: Mapping[str, Kind], metadata: Mapping[str, str], pieces: Callable[[str], Iterable[Tensor]]
) -> None:
    """Write a file of tensors.

    Args:
        kinds: of all of them.
        metadata: texts that join the header.
        pieces: asked for each tensor, in the order of :func:`in_order`: its rows from first to last, in as many tensors
        as it likes.

    Raises:
        ValueError: pieces are of another type, or not as many numbers as announced.
    """
    header: dict[str, object] = {"__metadata__": dict(metadata)}
    at = 0
    for name in in_order(kinds):
        dtype, shape = kinds[name]
        size = math.prod(shape) * dtype.itemsize
        header[name] = {"dtype": _NAMES[dtype], "shape": list(shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name in in_order(kinds):
            dtype, shape = kinds[name]
            left = math.prod(shape)
            for piece in pieces(name):
                if piece.dtype != dtype or piece.numel() > left:
                    raise ValueError(
                        f"{name}: a piece of {piece.numel()} {piece.dtype}; expected {dtype}, {left} at most"
                    )
                left -= piece.numel()
                file.write(piece.detach().cpu().contiguous().numpy().tobytes())
            if left:
                raise ValueError(f"{name}: {left} numbers are missing of {tuple(shape)}")
