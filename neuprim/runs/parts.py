"""Files of a model whose primitives are in parts: each rank brings its rows, the first one writes them as they come,
and each reads its own again.

No rank has the whole training state in memory at any time. The files are those of any run, which go on with any number
of ranks, in parts or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from neuprim.config import RunConfig
from neuprim.core import checkpoint
from neuprim.core.errors import CheckpointError
from neuprim.core.io.safetensors_stream import TensorType, storage_order
from neuprim.core.train.distributed import Alone
from neuprim.core.train.distributed.refusals import refuse_parts
from neuprim.core.train.restoring import by_row, by_row_name
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import Fitted

__all__ = ["assemble", "in_parts", "read_part", "write_parts"]


def in_parts(config: RunConfig, ranks: Alone) -> Alone:
    """The ranks that train a configuration: as they are, or with a part of the primitives each.

    Raises:
        ConfigError: ``train.shard`` with what cannot be in parts.
    """
    if not config.train.shard:
        return ranks
    refuse_parts(config.train, ranks.size)
    from neuprim.core.train.distributed.shards import shards_of

    near = config.renderer.near
    return shards_of(ranks, 0.0 if near == "auto" else near)  # decided later, and with less culled images are the same


def write_parts(
    path: Path,
    kind: str,
    trainer: Trainer,
    tensors: Mapping[str, Tensor],
    header: Mapping[str, Any],
    rows: Callable[[str, Tensor], bool] = by_row,
) -> None:
    """As :func:`~neuprim.core.checkpoint.write`, of tensors of which this rank has its rows; called on all ranks,
    written by the first.

    Args:
        rows: which tensors are those; of the others every rank has all.

    Raises:
        CheckpointError: the file could not be written; names it and the reason.
    """
    ranks = trainer.ranks
    kinds: dict[str, TensorType] = {}
    for name, value in tensors.items():
        kinds[name] = value.dtype, ((trainer.count, *value.shape[1:]) if rows(name, value) else tuple(value.shape))

    def pieces(name: str) -> Iterator[Tensor]:
        value = tensors[name]
        return ranks.collected(value) if rows(name, value) else iter([value])

    if ranks.first:
        checkpoint.write_in_pieces(path, kind, kinds, header, pieces)
        return
    for name in storage_order(kinds):
        for _ in pieces(name):
            pass


def read_part(path: Path, kind: str, ranks: Alone) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Header and tensors of a checkpoint, of which this rank reads its rows alone."""
    shape = checkpoint.shapes(path, kind).get("params.means", ())
    if not shape:
        raise CheckpointError(f"{path}: has no params.means; expected the positions of the primitives")
    mine = slice(*ranks.own_of(shape[0]))
    return checkpoint.read(path, kind, lambda name, shape: mine if shape and by_row_name(name) else None)


def assemble(fitted: Fitted, directory: Path) -> None:
    """At the end, on the first rank: the whole model's parameters, as its file has them, take the place of this rank's
    part and its moments."""
    if fitted.trainer.ranks.parts:
        model, _ = checkpoint.load_model(directory / "model.safetensors", fitted.task)
        fitted.trainer.leave(model.params)
