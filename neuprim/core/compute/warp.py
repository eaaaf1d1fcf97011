"""Warp, started as the kernels of :mod:`neuprim.core.render.cuda` need it, and the only place that launches one of them.

A frame is a dozen launches with a hundred arrays. Warp's own way to make an array of a tensor and to pack it for a launch takes longer than
the kernels of a small frame, so arrays are bare descriptors here, and on a card a kernel's launch is recorded once and given new arguments.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from neuprim.core.io import files

__all__ = ["BLOCK", "OPTIONS", "array", "launch", "wp"]

BLOCK = 256
"""Threads of a block where a kernel asks for nothing else."""

OPTIONS = {"enable_backward": False, "fast_math": False, "max_unroll": 16}
"""Of every kernel's module: adjoints are written by hand, and divisions and roots are rounded properly."""


def _start() -> None:
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    wp.config.enable_cpu_blocks = True  # without it a block on the CPU is one thread, and nothing complains
    wp.config.kernel_cache_dir = os.fspath(files.cache_directory() / "warp")
    wp.init()


_start()


_Bare: Any = type(wp.from_torch(torch.empty(1), return_ctype=True))


class _Array(_Bare):  # type: ignore[misc]
    """A descriptor of a tensor's memory, which it keeps alive."""

    tensor: Tensor


@functools.cache
def _bytes(dtype: Any) -> int:
    return int(wp.types.type_size_in_bytes(dtype))


def array(tensor: Tensor, dtype: Any) -> Any:
    """A contiguous tensor as a Warp array of its memory; ``dtype`` may take several numbers together, those of the last dimension."""
    assert tensor.is_contiguous(), "arrays of kernels are contiguous"
    size, shape = tensor.element_size(), tensor.shape
    whole = _bytes(dtype)
    if whole != size:
        assert shape[-1] * size == whole, f"{shape[-1]} numbers of {size} bytes; expected {whole} bytes together"
        shape = shape[:-1]
    ndim = len(shape)
    strides, step = [0] * ndim, whole
    for i in range(ndim - 1, -1, -1):
        strides[i] = step
        step *= shape[i]
    made = _Array(tensor.data_ptr(), 0, ndim, shape, strides)
    made.tensor = tensor
    return made


_recorded: dict[tuple[Any, int, int], Any] = {}
_streams: dict[tuple[int, int], Any] = {}
_turn = threading.Lock()  # a recorded launch has one set of arguments


def _stream(device: torch.device) -> Any:
    """The caller's stream."""
    current = torch.cuda.current_stream(device)
    key = (current.device_index, current.cuda_stream)
    if key not in _streams:
        _streams[key] = wp.stream_from_torch(current)
    return _streams[key]


def launch(kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: torch.device, block: int = BLOCK) -> None:
    """Run a kernel on the caller's stream; ``dim`` empty, nothing.

    Raises:
        RuntimeError: blocks on the CPU are off, so that results would be wrong.
    """
    if not wp.config.enable_cpu_blocks:
        raise RuntimeError("Warp runs blocks on the CPU as single threads: wp.config.enable_cpu_blocks was turned off")
    dims = (dim,) if isinstance(dim, int) else tuple(dim)
    if 0 in dims:
        return
    if device.type != "cuda":
        wp.launch(kernel, dim=dims, inputs=list(inputs), device="cpu", block_dim=block)
        return
    stream = _stream(device)
    key = (kernel, stream.device.ordinal, block)
    with _turn:
        command = _recorded.get(key)
        if command is None:
            command = wp.launch(kernel, dim=dims, inputs=list(inputs), device=stream.device, block_dim=block, record_cmd=True)
            _recorded[key] = command
        else:
            command.set_dim(dims)
            for i, value in enumerate(inputs):
                if isinstance(value, int | float | _Bare):
                    command.set_param_at_index_from_ctype(i, value)
                else:
                    command.set_param_at_index(i, value)
        command.launch(stream)
