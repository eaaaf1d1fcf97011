"""Write safetensors files row by row, when no process has a whole tensor in memory.

Format (https://github.com/huggingface/safetensors): the header's length as eight bytes, the header in JSON, then the
tensors' bytes without gaps. The library itself writes only whole tensors; it reads these files as its own.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

__all__ = ["TensorType", "storage_order", "write_safetensors_stream"]

TensorType = tuple[torch.dtype, tuple[int, ...]]
"""dtype and shape of a tensor."""

_NAMES = {
    torch.float32: "F32",
    torch.float64: "F64",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}


def storage_order(types: Mapping[str, TensorType]) -> list[str]:
    """Names in the order of the file: wide numbers first, so that all tensors are aligned."""
    return sorted(types, key=lambda name: (-types[name][0].itemsize, name))


def write_safetensors_stream(
    path: Path,
    types: Mapping[str, TensorType],
    metadata: Mapping[str, str],
    chunks: Callable[[str], Iterable[Tensor]],
) -> None:
    """Write a file of tensors whose rows arrive in chunks.

    Args:
        types: of all tensors.
        metadata: texts for the header.
        chunks: called for each tensor in :func:`storage_order`; gives its rows, first to last, in any number of
            tensors.

    Raises:
        ValueError: chunks of another dtype, or another number of values than announced.
    """
    header: dict[str, object] = {"__metadata__": dict(metadata)}
    at = 0
    for name in storage_order(types):
        dtype, shape = types[name]
        size = math.prod(shape) * dtype.itemsize
        header[name] = {"dtype": _NAMES[dtype], "shape": list(shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name in storage_order(types):
            dtype, shape = types[name]
            left = math.prod(shape)
            for chunk in chunks(name):
                if chunk.dtype != dtype or chunk.numel() > left:
                    raise ValueError(
                        f"{name}: a chunk of {chunk.numel()} {chunk.dtype}; expected {dtype}, {left} at most"
                    )
                left -= chunk.numel()
                file.write(chunk.detach().cpu().contiguous().numpy().tobytes())
            if left:
                raise ValueError(f"{name}: {left} numbers are missing of {tuple(shape)}")
