"""A card that is not there: tensors that say they are on another device, with their numbers in the processor's memory.

What a card refuses, this refuses: tensors of both devices in one operation, other than a single number or an index, and
reading a tensor as a numpy array. What makes a processor wait for a card is counted. The device is torch's "meta",
which no operation of torch takes for the processor's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_iter, tree_map

from neuprim.core.compute import device
from neuprim.core.render import backends
from neuprim.core.render.backends import Backend
from neuprim.core.render.cpu.backend import render as draw_on_processor
from neuprim.core.render.output import Draw, RenderOutput, draw_on_device

__all__ = ["CARD", "Card", "pretended"]

CARD = torch.device("meta")

_INDEXED = ("aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_")
_BETWEEN = ("aten::copy_", "aten::_to_copy")
_WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::repeat_interleave")


class _OnCard(Tensor):
    """A tensor on the card; ``held`` are its numbers."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> _OnCard:
        made: _OnCard = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=CARD
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func}: an operation outside the pretended card")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __repr__(self, *_: Any, **__: Any) -> str:  # type: ignore[override]
        return f"on the card: {self.held!r}"


class Card(TorchDispatchMode):
    """Operations while a card is pretended.

    Attributes:
        waits: how often the processor waited for the card, by operation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = kwargs or {}, func._schema.name
        asked = kwargs.get("device")
        tensors = [x for x in tree_iter((args, kwargs)) if isinstance(x, Tensor)]
        cards = [x for x in tensors if isinstance(x, _OnCard)]
        if cards and len(cards) < len(tensors) and name not in _BETWEEN:
            pointwise = torch.Tag.pointwise in func.tags
            for other in tensors:
                allowed = isinstance(other, _OnCard) or (other.dim() == 0 and (pointwise or name in _INDEXED))
                if not allowed and not (
                    name in _INDEXED and isinstance(args[0], _OnCard) and other.dtype in (torch.int64, torch.bool)
                ):
                    raise RuntimeError(
                        f"{name}: expected all tensors to be on the same device, found "
                        f"{[str(x.device) for x in tensors]}"
                    )
        if cards and (
            name in _WAITS or (name == "aten::_to_copy" and asked is not None and torch.device(asked).type == "cpu")
        ):
            self.waits["copy to the host" if name == "aten::_to_copy" else name.removeprefix("aten::")] += 1
        if (
            name == "aten::_to_copy"
            and not cards
            and asked is not None
            and torch.device(asked) == CARD
            and not kwargs.get("non_blocking")
        ):
            self.waits["copy to the card"] += 1
        if (
            name in _INDEXED
            and any(isinstance(x, Tensor) and x.dtype == torch.bool for x in tree_iter(args[1]))
            and cards
        ):
            self.waits["index by a mask"] += 1
        if asked is not None:
            kwargs = {**kwargs, "device": torch.device("cpu")}
        result = func(*tree_map(_held, args), **tree_map(_held, kwargs))
        if name == "aten::_local_scalar_dense":
            return result
        there = bool(cards) if asked is None else torch.device(asked) == CARD
        if there:
            result = tree_map(lambda x: _OnCard(x) if isinstance(x, Tensor) else x, result)
        elif not cards:
            return result
        return return_and_correct_aliasing(func, args, kwargs, result) if asked is None else result


class _Written(TorchFunctionMode):
    """``torch.tensor`` of Python numbers on the card, which torch makes past the dispatcher."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            return func(*args, **{**kwargs, "device": None}).to(kwargs["device"])  # a wait, too
        return func(*args, **kwargs)


def _held(value: Any) -> Any:
    return value.held if isinstance(value, _OnCard) else value


@contextmanager
def pretended(monkeypatch: pytest.MonkeyPatch, memory: int = 1 << 30) -> Iterator[Card]:
    """Inside, this machine has a card with some bytes of memory, and a backend that draws on it: the processor's, with
    what it takes and makes moved."""
    with monkeypatch.context() as patch:
        patch.setattr(device, "CUDA", CARD.type)
        patch.setattr(device, "DEVICE_TYPES", ("cpu", CARD.type))
        patch.setattr(device, "cuda_unavailable", lambda: None)
        patch.setattr(device, "current_device", torch.device)
        patch.setattr(device, "free_cuda_memory", lambda where: memory)
        patch.setattr(
            device,
            "copy_to_device",
            lambda tensor, where: tensor.to(where) if where != CARD else _OnCard(tensor.clone()),
        )  # in any thread
        patch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # which knows nothing of this device
        card = Card()

        def load() -> Draw:
            def draw(*frame: Any) -> RenderOutput:
                before = card.waits.copy()
                output = draw_on_device(draw_on_processor, torch.device("cpu"))(*frame)
                card.waits = before  # for the numbers that the pretended backend moves
                return output

            return draw

        row = Backend(
            "card", load, backends.unsupported_by_kernels, lambda: "a pretended card", checks=True, devices=(CARD.type,)
        )
        patch.setattr(backends, "TABLE", (row, *backends.TABLE))
        with _Written(), card:
            yield card
