"""Model files and checkpoint files: safetensors with one JSON header. Reading a file never executes its content.

A *model* file holds only what rendering needs; a *checkpoint* holds the exact training state. A model file may also be
compressed (:mod:`neuprim.core.compression`). All functions that read models accept plain and compressed files, and
recognise the kind by the first bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from neuprim.core.compression.codec import (
    Quantizers,
    StoredSize,
    canonical_model,
    encode_sections,
    fit_quantizers,
    format_quantizer_bits,
)
from neuprim.core.compression.file import CONFIG, is_compressed, read_compressed, read_model_header, write_compressed
from neuprim.core.compression.quantizers import BitTable
from neuprim.core.compression.sections import TEXT, CompressedSection
from neuprim.core.errors import CheckpointError, cut_error_text, nearest
from neuprim.core.io.files import atomic_path
from neuprim.core.io.json_reader import finite_json_number, load_json
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import dense_primitive_parameters, sparse_primitive_parameters
from neuprim.core.task import TaskSpec

__all__ = ["load_model_checkpoint", "read_header", "save_model"]

FORMAT = 1
_KEY = "neuprim"
_NUMBERS = ("step", "elapsed", "views", "iterations", "train_seconds", "primitives")
"""Header entries that are checked when a file is read: each is null, missing, or a number of at least 0."""


def write_tensors(path: Path, kind: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors, ``kind`` and a JSON header atomically: a failed write leaves the previous file unchanged."""
    text = json.dumps({"format": FORMAT, "kind": kind, **header}, allow_nan=False)
    compact = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    try:
        with atomic_path(path) as temporary:
            save_file(compact, str(temporary), metadata={_KEY: text})
    except (OSError, SafetensorError) as error:
        left = "a file that was there before is unchanged"
        raise CheckpointError(f"{path}: could not write the {kind}: {error}; {left}") from error


def read_header(path: Path, kind: str) -> dict[str, Any]:
    """Return the JSON header of a file without reading a tensor; ``kind`` is "model" or "checkpoint".

    Raises:
        CheckpointError: the file is missing, truncated, written by another program, or of another format version.
    """
    if is_compressed(path):
        return _check_model_header(path, read_model_header(path), kind)
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such {kind}") from None
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:  # RuntimeError: replaced while being opened
        raise CheckpointError(
            f"{path}: not a readable {kind} (safetensors: {error}); the file is damaged or of another kind"
        ) from error
    if _KEY not in metadata:
        raise CheckpointError(f"{path}: no {_KEY!r} header found; expected a {kind} written by neuprim")
    try:
        header = load_json(metadata[_KEY])
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: the {_KEY!r} header is not valid JSON ({error})") from error
    return _check_model_header(path, header, kind)


def _check_model_header(path: Path, header: Any, kind: str) -> dict[str, Any]:
    if not isinstance(header, dict) or header.get("kind") != kind:
        found = header.get("kind") if isinstance(header, dict) else type(header).__name__
        raise CheckpointError(f"{path}: the header states kind {cut_error_text(repr(found))}; expected {kind!r}")
    if header.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: format version is {cut_error_text(repr(header.get('format')))}; this neuprim reads {FORMAT}"
        )
    for name in _NUMBERS:  # in any header; null: not known
        number = 0.0 if header.get(name) is None else finite_json_number(header[name])
        if number is None or number < 0:
            raise CheckpointError(
                f"{path}: {name} is {cut_error_text(repr(header[name]))}; expected a number of at least 0"
            )
    background = header.get("background", [])
    if not isinstance(background, list) or any(finite_json_number(value) is None for value in background):
        raise CheckpointError(f"{path}: background is {cut_error_text(repr(background))}; expected finite numbers")
    return header


def shapes(path: Path, kind: str) -> dict[str, tuple[int, ...]]:
    """Return tensor name -> shape of a file that is not compressed, without reading a tensor."""
    read_header(path, kind)
    with safe_open(str(path), framework="pt") as file:
        return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}


def read_tensors(
    path: Path, kind: str, rows: Callable[[str, tuple[int, ...]], slice | None] = lambda name, shape: None
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the JSON header and the tensors of a file; refuse a header that claims more data than the file has.

    Args:
        rows: function (tensor name, shape) -> slice of the rows to read, or None for all rows. For compressed files,
            all rows are read and this argument is ignored.
    """
    if is_compressed(path):
        header, tensors, _ = read_compressed(path)
        return _check_model_header(path, header, kind), tensors
    header = read_header(path, kind)
    try:
        with safe_open(str(path), framework="pt") as file:
            found = {name: file.get_slice(name) for name in file.keys()}
            parts = {name: rows(name, tuple(one.get_shape())) for name, one in found.items()}
            empty = {name for name, one in found.items() if 0 in one.get_shape()}  # safetensors cannot slice these
            tensors = {
                name: found[name][part] if part and name not in empty else file.get_tensor(name)
                for name, part in parts.items()
            }
            tensors |= {name: tensors[name][part] for name, part in parts.items() if part and name in empty}
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path}: tensors of the {kind} are unreadable: {error}") from error
    return header, tensors


def save_model(path: Path, model: Primitives, task: str, extra: Mapping[str, Any], without_zeros: bool = False) -> None:
    """Write a model file, which holds all that rendering needs. An interrupted write leaves no partial file.

    Args:
        task: name of the task.
        extra: JSON-able entries of the header: background, colour space, data source.
        without_zeros: whether to store parameters sparsely where that takes less space; for pruned models.
    """
    specs = (*model.density.parameters(), *model.colour.parameters()) if without_zeros else ()
    tensors, sparse = sparse_primitive_parameters(model.params, specs)
    write_tensors(
        path, "model", tensors, {**model_header(model, task, extra), **({"sparse": sparse} if sparse else {})}
    )


def save_compressed(
    path: Path,
    model: Primitives,
    task: str,
    extra: Mapping[str, Any],
    bits: BitTable | Quantizers,
    config: str | None = None,
) -> dict[str, StoredSize]:
    """Write a quantised model file (``.neuprim``); return parameter name -> stored size.

    The arguments ``path``, ``task`` and ``extra`` are those of :func:`save_model`.

    Args:
        bits: bits per parameter, or quantizers fitted to ``model``, which must then be a :func:`canonical_model`.
        config: text of the run's ``config.yaml``, from which a run directory can be restored.
    """
    if isinstance(bits, BitTable):
        model = canonical_model(model)
        made = fit_quantizers(model, bits)
    else:
        made = bits
    sections = encode_sections(model, made)
    if config is not None:
        sections.insert(0, CompressedSection(CONFIG, TEXT, (), planes=(config.encode(),)))
    header = {"format": FORMAT, "kind": "model", **model_header(model, task, extra)}
    sizes = write_compressed(path, header, model.count, sections)
    return {name: StoredSize(format_quantizer_bits(scheme), sizes[name]) for name, scheme in made.items()}


def checkpoint_config(path: Path) -> str | None:
    """Return the text of the ``config.yaml`` in a compressed model file; None if the file has none."""
    return read_compressed(path)[2]


def model_header(model: Primitives, task: str, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the header that :func:`save_model` writes, without its entries ``format`` and ``kind``."""
    fields = {
        kind: {"class": type(field).__name__, "settings": field.settings()}
        for kind, field in (("density", model.density), ("colour", model.colour))
    }
    return {"task": task, "primitives": model.count, **fields, **extra}


def read_header_extra(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``extra`` entries that :func:`save_model` added to a model's header."""
    own = ("format", "kind", "task", "primitives", "density", "colour")
    return {key: value for key, value in header.items() if key not in own}


def load_model_checkpoint(path: Path, task: TaskSpec) -> tuple[Primitives, dict[str, Any]]:
    """Return the model in ``path`` and its header.

    Raises:
        CheckpointError: the file is damaged or of another task, or its fields or tensors do not fit the task.
    """
    header = read_header(path, "model")
    if header.get("task") != task.name:
        raise CheckpointError(
            f"{path}: written for task {cut_error_text(repr(header.get('task')))}; expected {task.name!r}"
        )
    density, colour = (_read_checkpoint_field(path, header, task, kind) for kind in ("density", "colour"))
    _, tensors = read_tensors(path, "model")
    if not isinstance(density, DensityField) or not isinstance(colour, ColourField):
        found = f"density field {type(density).__name__} and colour field {type(colour).__name__}"
        raise CheckpointError(f"{path}: {found}; expected a subclass of DensityField and one of ColourField")
    own = (*density.parameters(), *colour.parameters())
    if "sparse" in header:
        tensors = dense_primitive_parameters(tensors, header.pop("sparse"), own, str(path))
    try:
        model = Primitives(density, colour, tensors)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    for name, value in tensors.items():
        if value.dtype != torch.float32:
            raise CheckpointError(f"{path}: {name} is {value.dtype}; expected torch.float32")
        if not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"{path}: {name} has NaN or infinite values")
    return model, header


def _read_checkpoint_field(path: Path, header: Mapping[str, Any], task: TaskSpec, kind: str) -> Any:
    entry, known = header.get(kind), task.fields or {}
    name, settings = (entry.get("class"), entry.get("settings")) if isinstance(entry, dict) else (None, None)
    if not isinstance(name, str) or not isinstance(settings, dict):
        expected = "{'class': ..., 'settings': {...}}"
        raise CheckpointError(f"{path}: header field {kind!r} is {cut_error_text(repr(entry))}; expected {expected}")
    if name not in known:
        who = f"unknown {kind} field {cut_error_text(name)!r} for task {task.name!r}"
        raise CheckpointError(f"{path}: {who}{nearest(name, known)}")
    for key, value in settings.items():
        plain = isinstance(value, int | float | str | list | None)
        if not plain or (isinstance(value, int) and abs(value) > 10_000):
            raise CheckpointError(
                f"{path}: {kind} setting {cut_error_text(key)}={cut_error_text(repr(value))} is refused; "
                "expected text, a list or a number, and integers of at most 10000"
            )
    try:
        return known[name](**settings)
    except (TypeError, ValueError) as error:
        refused = f"{kind} field {name!r} refused its settings {cut_error_text(str(settings))}"
        raise CheckpointError(f"{path}: {refused}: {error}") from error
