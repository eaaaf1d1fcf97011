"""Counts how often the CPU would wait for a GPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

SHAPES = ("aten::nonzero", "aten::masked_select", "aten::equal", "aten::_local_scalar_dense")


@contextmanager
def counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What waited, by name."""
    waits: list[str] = []

    class Operations(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            name = func._schema.name
            mask = name == "aten::index" and any(x is not None and x.dtype == torch.bool for x in args[1])
            sized = name == "aten::repeat_interleave" and "output_size" not in (kwargs or {})
            if name in SHAPES or mask or sized:
                waits.append(name)
            return func(*args, **(kwargs or {}))

    genuine = Tensor.tolist
    with monkeypatch.context() as patch, Operations():
        patch.setattr(Tensor, "tolist", lambda self: waits.append("tolist") or genuine(self))
        yield waits
