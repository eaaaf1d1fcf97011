"""Forms with one thing wrong, drawn by some backends: each must be refused by name. Run by ``test_forms.py`` in a
process of its own.

    python -m tests.numerics.forms_fuzz [COUNT] [SEED] [BACKEND ...]

Between them are forms that only look odd (strides, views, mixed dtypes), which must be drawn, forward and backward, as
plain ones are.
Prints one line of counts; what goes wrong is an exception, or the end of the process.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import SLOW_HERE, by

CAMERA = scenes.camera(9, 7)
PARTS = ("geometry", "density", "colour")
SIZED_BY = {"W1": "b1", "Wx": "bias", "base": "Wout", "means": "log_scales"}
"""The first tensor of a form -> the one that is named where both do not fit, as the first says how large it must be."""


def tensors_of(lowered: LoweredPrimitives) -> dict[str, tuple[str, Tensor]]:
    """Tensor name -> (part of the form that holds it, the tensor)."""
    found = {}
    for part in PARTS:
        form = getattr(lowered, part)
        found |= {f.name: (part, v) for f in fields(form) if isinstance(v := getattr(form, f.name), Tensor)}
    return found


def with_tensor(lowered: LoweredPrimitives, name: str, value: Any) -> LoweredPrimitives:
    part = next(p for p in PARTS if hasattr(getattr(lowered, p), name))
    return replace(lowered, **{part: replace(getattr(lowered, part), **{name: value})})


def random_form(r: random.Random) -> LoweredPrimitives:
    hidden, sizes = r.choice([None, None, 0, 3, 4]), ([1, 2, 3, 7, 20], [0, 1, 4, 8], [1, 3, 3, 5])
    t = scenes.tensors(*map(r.choice, sizes), seed=r.randrange(1000), hidden=hidden)
    if r.random() < 0.3:
        t = {k: v.double() for k, v in t.items()}
    if r.random() < 0.3:
        t["b2"] = t["b2"][:, 0]
    return scenes.lowered(t)


# ---------------------------------------------------------------- what is wrong; None where it would be right by chance


def _other_size(r: random.Random, v: Tensor) -> Tensor:
    """One axis shorter, longer or gone."""
    axis = r.randrange(v.dim())
    if v.shape[axis] and r.random() < 0.5:
        return v.narrow(axis, 0, r.randrange(v.shape[axis]))
    return torch.cat([v, v[: r.choice([1, 1, 5])]])


def _numbers(r: random.Random, v: Tensor) -> Tensor:
    """As many numbers or fewer, in a row."""
    flat = v.reshape(-1)
    return flat[: r.randrange(len(flat) + 1)]


def _swapped(r: random.Random, v: Tensor) -> Tensor:
    a, b = (r.randrange(v.dim()) for _ in range(2))
    return v.transpose(a, b)


def _more_axes(r: random.Random, v: Tensor) -> Tensor:
    return v.unsqueeze(r.randrange(v.dim() + 1))


def _fewer_axes(r: random.Random, v: Tensor) -> Tensor:
    return v.reshape(-1) if r.random() < 0.5 or not v.shape[0] else v[0]


def _expanded(r: random.Random, v: Tensor) -> Tensor:
    """A view of one row or number, of another size than the form's: strides of 0."""
    size = list(v.shape)
    size[r.randrange(len(size))] += r.choice([1, 2, 100])
    return v.reshape(-1)[:1].reshape([1] * v.dim()).expand(size) if v.numel() else v.new_zeros(1).expand(3)


def _dtype(r: random.Random, v: Tensor) -> Tensor:
    return v.to(getattr(torch, r.choice(["int32", "int64", "float16", "bfloat16", "complex64", "bool", "uint8"])))


def _elsewhere(r: random.Random, v: Tensor) -> Tensor:
    return v.to("meta")


def _layout(r: random.Random, v: Tensor) -> Tensor:
    return v.to_sparse()


def _type(r: random.Random, v: Tensor) -> Any:
    return r.choice([None, v.tolist(), v.numpy(), 0.5, "w2"])


FAULTS: tuple[Callable[[random.Random, Tensor], Any], ...] = (
    _other_size, _numbers, _swapped, _more_axes, _fewer_axes, _expanded, _dtype, _elsewhere, _layout, _type,
)  # fmt: skip


def legal(lowered: LoweredPrimitives, name: str, value: Any) -> bool:
    """Whether the changed tensor is as good as the one it replaces."""
    old = tensors_of(lowered)[name][1]
    if not isinstance(value, Tensor) or value.dtype not in (torch.float32, torch.float64):
        return False
    if value.device.type != "cpu" or value.layout != torch.strided:
        return False
    n = lowered.geometry.count
    either = {(n,), (n, 1)} if name == "b2" else {tuple(old.shape)}
    # nothing else fixes the channels of constant colours
    return tuple(value.shape) in either or (
        name == "rgb" and value.dim() == 2 and len(value) == n and value.shape[1] > 0
    )


def draw(lowered: LoweredPrimitives, backend: str) -> tuple[Tensor, dict[str, Tensor | None]]:
    """The image, and the gradients of all tensors."""
    leaves = {name: v.detach().requires_grad_() for name, (_, v) in tensors_of(lowered).items()}
    for name, value in leaves.items():
        lowered = with_tensor(lowered, name, value)
    settings = RenderSettings(**by(backend), sort=random.choice(["center", "entry"]))  # type: ignore[arg-type]
    image = render_lowered(lowered, CAMERA, settings).rgb
    image.sum().backward()
    return image.detach(), {name: v.grad for name, v in leaves.items()}


def refuse(lowered: LoweredPrimitives, backend: str, name: str, background: Any = None) -> None:
    try:
        image = render_lowered(lowered, CAMERA, RenderSettings(**by(backend)), background).rgb
    except FormError as error:
        text = str(error)
        blamed = (name, SIZED_BY.get(name, name))
        if not any(word in text for word in blamed) or "expected" not in text or "\n" in text:
            raise AssertionError(f"{backend}: {name} is wrong, but the message is {text!r}") from error
        return
    if image.requires_grad:
        image.sum().backward()
    shapes = [(k, tuple(v.shape)) for k, (_, v) in tensors_of(lowered).items()]
    raise AssertionError(f"{backend}: a wrong {name} was drawn: {shapes}")


def _strided(r: random.Random, v: Tensor) -> Tensor:
    """The same numbers in another layout."""
    kind = r.randrange(3)
    if kind == 0:
        return v.transpose(0, -1).contiguous().transpose(0, -1)
    if kind == 1:
        return torch.stack([v, v + 1], -1)[..., 0]
    return torch.complex(torch.zeros_like(v), -v).conj().imag  # a lazily negated view, which numpy does not take


def same(r: random.Random, lowered: LoweredPrimitives, backend: str) -> None:
    """Odd strides, and some tensors in another dtype: the same picture and gradients."""
    odd = lowered
    for name, (_, value) in tensors_of(lowered).items():
        odd = with_tensor(odd, name, _strided(r, value) if r.random() < 0.7 else value)
    random.seed(1)
    a = draw(lowered, backend)
    random.seed(1)
    b = draw(odd, backend)
    assert torch.equal(a[0], b[0]), f"{backend}: strides change the picture"
    for name, grad in a[1].items():
        other = b[1][name]
        assert grad is other is None or (grad is not None and other is not None and torch.equal(grad, other)), name


def main(count: int, seed: int, backends: list[str]) -> None:
    torch.set_num_threads(1)
    r = random.Random(seed)
    refused = skipped = drawn = 0
    while refused < count:
        lowered, backend = random_form(r), backends[refused % len(backends)]
        name = r.choice([*tensors_of(lowered), "background", "rows", "omega0"])
        if name == "background":
            channels = getattr(lowered.colour, "rgb", getattr(lowered.colour, "base", None)).shape[1]  # type: ignore[union-attr]
            right = torch.ones(channels)
            value: Any = r.choice([torch.ones(channels + 1), right[1:], right[None], right.long(), 1])
            refuse(lowered, backend, name, value)
        elif name == "rows":
            right = torch.arange(lowered.geometry.count)
            rows = [torch.arange(len(right) + 1), right.float(), right[:, None], right - 1, right.tolist()]
            refuse(replace(lowered, rows=r.choice(rows)), backend, name)
        elif name == "omega0":
            value = r.choice([float("nan"), float("inf"), torch.tensor(3.0), "30", None, True])
            refuse(with_tensor(lowered, name, value), backend, name)
        else:
            value = r.choice(FAULTS)(r, tensors_of(lowered)[name][1])
            if legal(lowered, name, value):
                skipped += 1
                continue
            refuse(with_tensor(lowered, name, value), backend, name)
        refused += 1
        if refused % 20 == 0:
            if backend in SLOW_HERE:  # kernels that other tests compile too
                lowered = scenes.lowered(scenes.tensors(7, seed=refused, hidden=r.choice([None, 8])))
            same(r, lowered, backend)
            drawn += 1
    print(f"{refused} wrong forms refused, {skipped} right by chance, {drawn} odd but right ones drawn alike")


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["2000"])[0]), int((sys.argv[2:] or ["0"])[0]), sys.argv[3:] or ["cpu", "reference"])
