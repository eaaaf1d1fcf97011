"""Configure Warp (NVIDIA's library of GPU kernels), and launch its kernels; no other module launches Warp kernels.

Converting tensors to Warp arrays and packing these arguments takes longer than the kernels of a small frame. So each
kernel's launch is recorded once per device, and later launches only overwrite the arguments of the recorded launch.
"""

from __future__ import annotations

import ctypes
import functools
import os
import threading
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp  # kernels import it from here, where it is initialised
from torch import Tensor

from neuprim.core.compute.kernels import code_cache
from neuprim.core.io import files

BLOCK = 256  # default threads per block

OPTIONS = {"enable_backward": False, "fast_math": False, "max_unroll": 16}
"""Module options of every kernel. Warp generates no backward kernels, because neuprim has its own. Divisions and square
roots are rounded as IEEE 754 requires."""

FAST = {**OPTIONS, "fast_math": True}
"""Module options of the float32 pixel kernels: approximate division, root and exponential, which a GPU computes to one
or two units in the last place. On an H100, errors were the same with and without ``fast_math`` (``benchmarks/gpu.py
--parts parity``), and kernels of small density forms took a third less time. The CPU ignores ``fast_math``."""


# ---- types of kernels' arrays, by what they hold
_SCALARS = wp.bool, wp.uint8, wp.uint16, wp.int32, wp.int64, wp.float32, wp.float64
_VECTORS = wp.vec2, wp.vec3, wp.vec4, wp.vec4i, wp.vec3d, wp.vec4d
Bools, Bytes, Shorts, Ints, Longs, Floats, Doubles = (wp.array(dtype=kind) for kind in _SCALARS)
Bools2d, Bytes2d, Shorts2d, Ints2d, Longs2d, Floats2d, Doubles2d = (wp.array2d(dtype=kind) for kind in _SCALARS)
Vec2s, Vec3s, Vec4s, Vec4is, Vec3ds, Vec4ds = (wp.array(dtype=kind) for kind in _VECTORS)
Vec2s2d, Vec3s2d, Vec4s2d, Vec4is2d, Vec3ds2d, Vec4ds2d = (wp.array2d(dtype=kind) for kind in _VECTORS)
Mat33ds, Floats3d = wp.array(dtype=wp.mat33d), wp.array3d(dtype=wp.float32)


def _start_warp() -> None:
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    wp.config.enable_cpu_blocks = True  # without it a block on the CPU is one thread, and nothing complains
    wp.config.kernel_cache_dir = os.fspath(code_cache(files.cache_directory() / "warp"))
    wp.init()


_start_warp()


_Bare: Any = type(wp.from_torch(torch.empty(1), return_ctype=True))


class _KernelArray:
    """A tensor to pass to a kernel as an array of ``dtype``; a vector dtype takes up the last dimension."""

    __slots__ = ("dtype", "tensor")

    def __init__(self, tensor: Tensor, dtype: Any) -> None:
        self.tensor, self.dtype = tensor, dtype


def array(tensor: Tensor, dtype: Any) -> Any:
    """Return a contiguous tensor as a kernel argument; a vector ``dtype`` takes up the last dimension."""
    return _KernelArray(tensor, dtype)


@functools.cache
def _kernel_dtype_bytes(dtype: Any) -> int:
    return int(wp.types.type_size_in_bytes(dtype))


def _fill_descriptor(given: _KernelArray, into: Any) -> None:
    """Write a tensor's address, shape and strides into the Warp array descriptor ``into``, for a kernel argument."""
    tensor, whole = given.tensor, _kernel_dtype_bytes(given.dtype)
    assert tensor.is_contiguous(), "arrays of kernels are contiguous"
    shape, size = tensor.shape, tensor.element_size()
    ndim = len(shape)
    if whole != size:
        ndim -= 1
        assert shape[ndim] * size == whole, f"{shape[ndim]} numbers of {size} bytes; expected {whole} bytes together"
    into.data, into.ndim = tensor.data_ptr(), ndim
    own, strides, step = into.shape, into.strides, whole
    for k in range(ndim - 1, -1, -1):
        own[k], strides[k] = shape[k], step
        step *= shape[k]


def _pack_argument(value: Any) -> Any:
    """Return a kernel argument in the type that Warp expects, in memory of its own."""
    if value is None:
        return _Bare()
    if isinstance(value, _KernelArray):
        made = _Bare()
        _fill_descriptor(value, made)
        return made
    return type(value)(*value) if isinstance(value, ctypes.Array) else value


class _RecordedLaunch:
    """A recorded launch of one kernel on one device; each new launch overwrites its arguments."""

    def __init__(self, kernel: Any, dims: tuple[int, ...], inputs: Sequence[Any], device: Any, block: int) -> None:
        packed = [_pack_argument(value) for value in inputs]
        self.command = wp.launch(kernel, dim=dims, inputs=packed, device=device, block_dim=block, record_cmd=True)
        self.dims, self.packed = dims, packed
        self.arguments = list(self.command.params[1:])

    def launch(self, dims: tuple[int, ...], inputs: Sequence[Any], stream: Any) -> None:
        if dims != self.dims:
            self.command.set_dim(dims)
            self.dims = dims
        for value, own in zip(inputs, self.arguments, strict=True):
            if type(value) is _KernelArray:
                _fill_descriptor(value, own)
            elif value is None:
                own.data = 0
            elif isinstance(value, ctypes.Array):
                ctypes.memmove(own, value, ctypes.sizeof(own))
            else:
                own.value = value
        self.command.launch(stream)


_recorded: dict[tuple[Any, int, int], _RecordedLaunch] = {}
_streams: dict[tuple[int, int], Any] = {}
_turn = threading.Lock()  # one caller at a time: a recorded launch has one set of arguments


def _device_stream_of_torch(device: torch.device) -> Any:
    """Return torch's current CUDA stream on the device as a Warp stream."""
    index = torch.cuda.current_device() if device.index is None else device.index
    key = (index, torch._C._cuda_getCurrentRawStream(index))
    if key not in _streams:
        _streams[key] = wp.stream_from_torch(torch.cuda.current_stream(device))
    return _streams[key]


def launch_kernel(
    kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: torch.device, block: int = BLOCK
) -> None:
    """Run a kernel with ``dim`` threads per axis on torch's current stream; do nothing if a ``dim`` is 0.

    ``inputs`` are the kernel's arguments: numbers, Warp vectors, results of :func:`array`, or None for an absent array.
    ``block`` is the number of threads per block.
    """
    if not wp.config.enable_cpu_blocks:
        raise RuntimeError("Warp runs blocks on the CPU as single threads: wp.config.enable_cpu_blocks was turned off")
    dims = (dim,) if isinstance(dim, int) else tuple(dim)
    if 0 in dims:
        return
    stream = _device_stream_of_torch(device) if device.type == "cuda" else None
    key = (kernel, -1 if stream is None else stream.device.ordinal, block)
    with _turn:
        recorded = _recorded.get(key)
        if recorded is None:
            recorded = _recorded[key] = _RecordedLaunch(
                kernel, dims, inputs, "cpu" if stream is None else stream.device, block
            )
        recorded.launch(dims, inputs, stream)
