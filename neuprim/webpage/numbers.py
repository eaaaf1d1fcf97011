"""A model's parameters in a page: codes of a few bits or whole floats, as byte planes, gzipped; ``assets/codec.js``
reads them."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from neuprim.core.compression import bit_table, canonicalize, fit_quantizers, storage_order
from neuprim.core.compression.quantizers import Rotations
from neuprim.core.compression.sections import COLUMNS, ROTATIONS, pack
from neuprim.core.model.primitives import Primitives


@dataclass(frozen=True)
class PackedModel:
    """A model as a page holds it.

    Attributes:
        parts: how each parameter is coded, in the order of ``data``.
        data: gzipped.
        model: what comes back.
    """

    parts: tuple[dict[str, Any], ...]
    data: bytes
    model: Primitives


def pack_model(model: Primitives, level: int) -> PackedModel:
    """All parameters: every bit of them at level 0, else in as few bits as ``neuprim compress --level`` 1 to 5 gives
    them.

    Raises:
        ConfigError: no such level.
        CheckpointError: numbers that cannot be stored.
    """
    made = _exact(model) if level == 0 else _coded(model, level)
    parts, planes, params = zip(*made, strict=True) if made else ((), (), ())
    data = gzip.compress(b"".join(planes), 9, mtime=0)
    return PackedModel(
        tuple(parts),
        data,
        Primitives(model.density, model.colour, {part["name"]: x for part, x in zip(parts, params, strict=True)}),
    )


_Made = list[tuple[dict[str, Any], bytes, Tensor]]


def _exact(model: Primitives) -> _Made:
    made: _Made = []
    for spec in model.specs:
        x = model.params[spec.name].detach().cpu().float().contiguous()
        whole = x.reshape(model.count, spec.size, 1).numpy().astype("<f4").view(np.uint8)  # (N, C, 4)
        planes = np.ascontiguousarray(whole.transpose(1, 2, 0)).tobytes()
        made.append(({"name": spec.name, "shape": list(spec.shape), "coding": "float32"}, planes, x))
    return made


def _coded(model: Primitives, level: int) -> _Made:
    own = canonicalize(model)
    found = fit_quantizers(own, bit_table(level, (), own.specs))
    order = storage_order(own, found)
    made: _Made = []
    for spec in own.specs:
        scheme = found[spec.name]
        codes = scheme.codes(own.params[spec.name].reshape(own.count, spec.size)[order])
        about: dict[str, Any] = {"name": spec.name, "shape": list(spec.shape)}
        if isinstance(scheme, Rotations):
            about |= {"coding": "rotations", "bits": scheme.bits}
        else:
            about |= {
                "coding": "columns",
                "bits": scheme.bits.tolist(),
                "low": scheme.low.tolist(),
                "high": scheme.high.tolist(),
            }
        section = pack(
            spec.name, spec.shape, scheme, codes.numpy(), ROTATIONS if isinstance(scheme, Rotations) else COLUMNS
        )
        made.append((about, b"".join(section.planes), scheme.values(codes).reshape(own.count, *spec.shape)))
    return made
