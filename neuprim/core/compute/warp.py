"""Warp, started as the kernels of :mod:`neuprim.core.render.cuda` need it, and the only place that launches one of them."""

from __future__ import annotations

import os
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


def array(tensor: Tensor, dtype: Any) -> Any:
    """A contiguous tensor as a Warp array of its memory; ``dtype`` may take several numbers together, and int16 may be unsigned."""
    if dtype is wp.uint16:  # which torch hardly knows
        assert tensor.dtype == torch.int16 and tensor.is_contiguous()
        kept = wp.array(ptr=tensor.data_ptr(), shape=tuple(tensor.shape), dtype=dtype, device=wp.device_from_torch(tensor.device))
        kept._tensor = tensor  # the memory's owner
        return kept
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def launch(kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: Any, block: int = BLOCK) -> None:
    """Run a kernel on the caller's stream; ``dim`` empty, nothing.

    Raises:
        RuntimeError: blocks on the CPU are off, so that results would be wrong.
    """
    if not wp.config.enable_cpu_blocks:
        raise RuntimeError("Warp runs blocks on the CPU as single threads: wp.config.enable_cpu_blocks was turned off")
    wp.launch(kernel, dim=dim, inputs=list(inputs), device=device, block_dim=block)
