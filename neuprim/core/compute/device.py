"""Devices of tensors (the CPU and CUDA devices), and tests which kernels can read which tensors."""

from __future__ import annotations

import functools
import importlib.util

import torch
from torch import Tensor

CPU, CUDA = "cpu", "cuda"
DEVICE_TYPES: tuple[str, ...] = (CPU, CUDA)  # the kinds of device that can hold a model

HOST = torch.device(CPU)


def on_numba(*tensors: Tensor) -> bool:
    """Return whether compiled CPU kernels can read all these tensors."""
    return all(tensor.is_cpu for tensor in tensors)


@functools.cache
def _warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def on_warp(*tensors: Tensor) -> bool:
    """Return whether Warp kernels (GPU) can read all these tensors."""
    return all(tensor.is_cuda for tensor in tensors) and _warp()


@functools.cache
def cuda_unavailable() -> str | None:
    """Return why torch finds no CUDA device; None if it finds one."""
    if torch.cuda.is_available():
        return None
    return "torch finds no CUDA device" if torch.backends.cuda.is_built() else "this torch was built without CUDA"


def current_device(kind: str) -> torch.device:
    """Return the torch device of ``kind``, "cpu" or "cuda"; with several GPUs, the current GPU of torch."""
    return torch.device(kind, torch.cuda.current_device()) if kind == CUDA else torch.device(kind)


def copy_to_device(tensor: Tensor, device: torch.device) -> Tensor:
    """Return the tensor on ``device``. A copy from the CPU to a GPU is asynchronous, through pinned memory."""
    if tensor.device == device:
        return tensor
    if device.type != CUDA or not tensor.is_cpu:
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def to_device_like(tensor: Tensor, like: Tensor) -> Tensor:
    """Return a small tensor on the device and in the dtype of ``like``; differentiable, asynchronous from the CPU."""
    return tensor.to(like, non_blocking=tensor.is_cpu)


def free_cuda_memory(device: torch.device) -> int:
    """Return the free bytes of a CUDA device's memory."""
    return int(torch.cuda.mem_get_info(device)[0])
