"""Model files without what is zero: pieces that primitives do without (:mod:`neuprim.core.model.pieces`) are left out row by row.

A parameter all of whose numbers belong to pieces is stored as one tensor ``NAME|KIND.PIECE`` per piece, with the rows that have it, if that is
less. Who has a piece stands in ``rows|KIND.PIECE``, uint8, a bit per primitive, the lowest bit first. Tensors in memory are whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError
from neuprim.core.model.pieces import Piece, alive
from neuprim.core.model.schema import ParameterSpec, Params

__all__ = ["split_off", "whole"]

_ROWS = "rows|"


def split_off(params: Params, specs: Sequence[ParameterSpec], pieces: Mapping[str, Piece]) -> tuple[dict[str, Tensor], list[str]]:
    """Tensors as a file holds them, and the names of the pieces that are stored apart.

    Args:
        pieces: name -> piece, of all fields of the model.
    """
    apart = {name: alive(piece, params) for name, piece in pieces.items()}
    apart = {name: has for name, has in apart.items() if not bool(has.all())}
    covered = {spec.name for spec in specs if _covered(spec, pieces)}
    apart = {name: has for name, has in apart.items() if set(pieces[name].places) <= covered}
    split = {name for piece in apart for name in pieces[piece].places}
    stored = {name: value for name, value in params.items() if name not in split}
    used = [name for name, piece in pieces.items() if set(piece.places) & split]
    for name in used:
        has = apart.get(name, torch.ones(len(params["means"]), dtype=torch.bool, device=params["means"].device))
        for parameter, value in pieces[name].of(params).items():
            if parameter in split:
                stored[f"{parameter}|{name}"] = value.detach()[has].contiguous()
        stored[_ROWS + name] = torch.from_numpy(np.packbits(has.cpu().numpy(), bitorder="little"))
    before, after = (sum(t.numel() * t.element_size() for t in tensors.values()) for tensors in (params, stored))
    return (stored, used) if after < before else (dict(params), [])


def _covered(spec: ParameterSpec, pieces: Mapping[str, Piece]) -> bool:
    """Whether every number of a parameter belongs to a piece."""
    seen = torch.zeros(spec.shape, dtype=torch.bool)
    for piece in pieces.values():
        if spec.name in piece.places:
            seen[piece.places[spec.name]] = True
    return bool(seen.all()) and spec.size > 0


def whole(stored: Params, names: object, specs: Sequence[ParameterSpec], pieces: Mapping[str, Piece], where: str) -> dict[str, Tensor]:
    """The tensors of a model from those of its file.

    Args:
        names: of the pieces that are stored apart, as the file's header has them.
        where: the file, for messages.

    Raises:
        CheckpointError: they do not fit the model's fields or each other.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) and name in pieces for name in names):
        raise CheckpointError(f"{where}: header field 'apart' is {names!r}; expected pieces of the model's fields: {', '.join(pieces)}")
    means = stored.get("means")
    if means is None or means.dim() != 2:
        raise CheckpointError(f"{where}: no tensor 'means' (N, 3)")
    count, shapes = len(means), {spec.name: spec.shape for spec in specs}
    found = {name: value for name, value in stored.items() if "|" not in name}
    taken = set(found)
    for name in names:
        has = _rows(stored.get(_ROWS + name), count, f"{where}: {_ROWS + name}")
        taken.add(_ROWS + name)
        for parameter, place in pieces[name].places.items():
            key = f"{parameter}|{name}"
            if key not in stored and parameter in stored:
                continue  # some of a piece's parameters may be whole
            target = found.setdefault(parameter, torch.zeros(count, *shapes[parameter]))
            wanted = (int(has.sum()), *target[(slice(None), *place)].shape[1:])
            part = stored.get(key)
            if part is None or tuple(part.shape) != wanted or part.dtype != torch.float32:
                shown = "missing" if part is None else f"{part.dtype} {tuple(part.shape)}"
                raise CheckpointError(f"{where}: {key} is {shown}; expected torch.float32 {wanted}")
            target[(has, *place)] = part
            taken.add(key)
    extra = sorted(set(stored) - taken)
    if extra:
        raise CheckpointError(f"{where}: tensor {extra[0]!r} belongs to no piece")
    return found


def _rows(bits: Tensor | None, count: int, what: str) -> Tensor:
    if bits is None or bits.dtype != torch.uint8 or tuple(bits.shape) != ((count + 7) // 8,):
        shown = "missing" if bits is None else f"{bits.dtype} {tuple(bits.shape)}"
        raise CheckpointError(f"{what} is {shown}; expected torch.uint8 ({(count + 7) // 8},)")
    return torch.from_numpy(np.unpackbits(bits.numpy(), count=count, bitorder="little").astype(bool))
