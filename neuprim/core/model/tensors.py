"""Checks of the tensors that compiled kernels read: dtype, layout, device and shape.

In an allowed shape such as ("N", "K", 3), a letter stands for a size that all checked tensors share. The functions
whose names end in ``fault`` return an error text, or None for valid input. :mod:`neuprim.core.model.checks` raises the
errors.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from neuprim.core.compute import device

Shape = tuple[int | str, ...]  # a letter stands for a size that tensors share, as in ("N", "K", 3)

Sizes = dict[str, tuple[int, str]]  # letter -> its size and the tensor that has it

MOST_UNITS = 256
"""Largest number of density neurons, or of hidden units of a colour network: kernels number neurons in one byte."""

_ANY = (0, sys.maxsize)
_RANGES = {"K": (0, MOST_UNITS), "H": (0, MOST_UNITS), "C": (1, sys.maxsize)}
_DTYPES = (torch.float32, torch.float64)


def primitive_tensor_fault(value: Any) -> str | None:
    """Return an error text if kernels cannot read ``value``, such as ``"dtype torch.int64; expected ..."``, else None.

    Kernels read dense float32 and float64 tensors on the devices that neuprim supports.
    """
    if not isinstance(value, Tensor):
        return f"type {type(value).__name__}; expected a torch tensor"
    if not value.is_cpu and value.device.type not in device.DEVICE_TYPES:
        return f"device {value.device}; expected {' or '.join(device.DEVICE_TYPES)}, where models are kept"
    if value.layout is not torch.strided or value.is_nested:
        return f"layout {'nested' if value.is_nested else value.layout}; expected a dense tensor"
    if value.dtype not in _DTYPES:
        return f"dtype {value.dtype}; expected torch.float32 or torch.float64"
    return None


def field_number_fault(value: Any) -> str | None:
    """Return an error text if ``value`` is not a finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"type {type(value).__name__}; expected a finite number"
    if abs(value) <= sys.float_info.max:
        return None
    return f"value {value if isinstance(value, float) else 'beyond the range of float64'}; expected a finite number"


def function_fault(value: Any) -> str | None:
    """Return an error text if ``value`` is not a function, else None."""
    return None if callable(value) else f"type {type(value).__name__}; expected a function"


def primitive_tensors_fault(tensors: Iterable[tuple[str, Any, tuple[Shape, ...]]], sizes: Sizes) -> str | None:
    """Return an error text for the first tensor that kernels cannot read or that has a wrong shape, or None.

    ``tensors`` holds entries (name, tensor, allowed shapes). ``sizes`` maps the letters in shapes to known sizes. The
    function adds each size that it finds to ``sizes``.
    """
    for name, value, shapes in tensors:
        fault = primitive_tensor_fault(value)
        if fault is None:
            for shape in shapes:
                if _fits_primitive_shape(value.shape, shape, name, sizes):
                    break
            else:
                fault = f"shape {tuple(value.shape)}; expected {_expected_primitive_shapes(shapes, sizes)}"
        if fault is not None:
            return f"{name} has {fault}"
    return None


def labelled_fault(name: str, fault: str | None) -> str | None:
    """Return the error text ``"NAME has FAULT"``, or None if ``fault``, a text without the name, is None."""
    return None if fault is None else f"{name} has {fault}"


def _fits_primitive_shape(found: torch.Size, shape: Shape, name: str, sizes: Sizes) -> bool:
    if len(found) != len(shape):
        return False
    fresh: Sizes | None = None
    for size, want in zip(found, shape):  # noqa: B905 - equally long, and this runs for every tensor of every frame
        if not isinstance(want, str):
            if size != want:
                return False
        elif (known := sizes.get(want)) is not None:
            if size != known[0]:
                return False
        else:
            low, high = _RANGES.get(want, _ANY)
            if not low <= size <= high:
                return False
            fresh = fresh or {}
            fresh[want] = (size, name)
    if fresh is not None:
        sizes.update(fresh)
    return True


def _expected_primitive_shapes(shapes: tuple[Shape, ...], sizes: Sizes) -> str:
    """Format allowed shapes for a message: numbers if all sizes are known, else letters with known sizes and limits."""
    letters = list(dict.fromkeys(d for d in shapes[0] if isinstance(d, str)))
    known, free = [x for x in letters if x in sizes], [x for x in letters if x not in sizes]
    if not free:
        numbers = [tuple(sizes[d][0] if isinstance(d, str) else d for d in shape) for shape in shapes]
        tensors = dict.fromkeys(sizes[x][1] for x in known)
        origins = " and ".join(
            f"{t} has " + " and ".join(f"{x}={sizes[x][0]}" for x in known if sizes[x][1] == t) for t in tensors
        )
        return " or ".join(map(str, numbers)) + (f", as {origins}" if origins else "")
    text = " or ".join(str(shape).replace("'", "") for shape in shapes)
    origins = " and ".join(f"{x}={sizes[x][0]} as in {sizes[x][1]}" for x in known)
    limits = [
        f", {x} {'at least' if low else 'at most'} {low or high}" for x, (low, high) in _RANGES.items() if x in free
    ]
    return text + (f" with {origins}" if origins else "") + "".join(limits)


Shapes = Mapping[str, tuple[Shape, ...]]
"""Map from the name of a tensor to its allowed shapes. A letter stands for the same size in all tensors of a frame."""


class PrimitiveTensors:
    """Base class of groups of tensors with one row per primitive, such as the tensors of a density. ``shapes`` maps the
    names of the tensors, which are attributes of the group, to their allowed shapes."""

    shapes: ClassVar[Shapes] = {}

    def tensors(self) -> dict[str, Tensor]:
        """Return name -> tensor with one row per primitive, for all tensors; messages use these names."""
        return {name: getattr(self, name) for name in self.shapes}

    @property
    def movable(self) -> bool:
        """Whether :meth:`to` can move the group to another device; False if the group has a function, not tensors."""
        return bool(self.shapes)

    def to(self, device: torch.device) -> Self:
        """Return a copy with its tensors on another device; differentiable."""
        return replace(self, **{name: getattr(self, name).to(device) for name in self.shapes})  # type: ignore[type-var]

    def fault(self, sizes: Sizes) -> str | None:
        """Return an error text for the first invalid tensor, ``"w2 has shape (5,); expected (100, 3), ..."``.

        Returns None if all tensors are valid. ``sizes`` maps the letters in shapes to known sizes; each size found is
        added to ``sizes``.
        """
        return primitive_tensors_fault(
            [(name, getattr(self, name), shapes) for name, shapes in self.shapes.items()], sizes
        )
