"""Checks that a data set keeps the promises of :class:`~neuprim.core.data.dataset.Dataset`.

Shapes and dtypes are checked whenever pixels are drawn. Values are checked once, for the first view of each split.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.projections import AnyCamera, RayCamera
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, DataSource, Pixels, PointCloud, PointSamples, PointSupervision, View, ViewSet
from neuprim.core.errors import DataError
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.volumes.source import Placement

__all__ = ["DatasetError", "check_dataset", "check_mask", "check_pixels", "check_points", "check_samples", "get_extra"]

Extra = TypeVar("Extra")


class DatasetError(DataError):
    """A loader broke a promise of :class:`~neuprim.core.data.dataset.Dataset`."""


def check_dataset(dataset: Dataset, conditions: Sequence[ConditionSpec]) -> None:
    """Check members, all views without pixels, and the pixels of the first view of both splits.

    Raises:
        DatasetError: names the member or view, what was found and what was expected.
    """
    _members(dataset)
    for split in ("train", "test"):
        views: ViewSet = getattr(dataset, split)
        if len(views) == 0:
            raise DatasetError(f"{dataset.name}: the {'training' if split == 'train' else split} split is empty")
        for i in range(len(views)):
            _view(views.view(i), f"{split} view {i}", conditions)
        view, pixels = views.view(0), views.pixels(0)
        check_pixels(split, view, pixels, dataset.channels)
        for name in ("rgb", "alpha"):
            value = getattr(pixels, name)
            if value is not None:
                _finite(value, f"{split} view {view.name}: {name}")


def check_pixels(split: str, view: View, pixels: Pixels, channels: int) -> None:
    """Check shapes and dtypes of the pixels of a view against its camera; raise DatasetError. ``split`` is for
    messages."""
    size = (view.camera.height, view.camera.width)
    if not isinstance(pixels, Pixels):
        raise DatasetError(
            f"{split} view {view.name}: pixels are {_described(pixels)}; expected a neuprim.core.data.Pixels"
        )
    rgb, alpha, mask = pixels.rgb, pixels.alpha, pixels.mask
    if not (_is(rgb, torch.float32) and rgb.shape == (*size, channels)):
        _refuse(f"{split} view {view.name}: rgb", rgb, torch.float32, (*size, channels), ", rows x columns x channels")
    if alpha is not None and not (_is(alpha, torch.float32) and alpha.shape == size):
        _refuse(f"{split} view {view.name}: alpha", alpha, torch.float32, size, ", rows x columns, or None")
    if mask is not None:
        check_mask(split, view, mask)


def check_mask(split: str, view: View, mask: Tensor) -> None:
    """Check a mask alone, as :func:`check_pixels` does."""
    size = (view.camera.height, view.camera.width)
    if not (_is(mask, torch.bool) and mask.shape == size):
        _refuse(f"{split} view {view.name}: mask", mask, torch.bool, size, ", rows x columns, or None")


def check_points(cloud: PointCloud, count: int, dataset: Dataset) -> None:
    """Check starting points, of which at most ``count`` were requested; raise DatasetError."""
    where = f"{dataset.name}: starting points"
    if not isinstance(cloud, PointCloud):
        raise DatasetError(f"{where}: found {_described(cloud)}; expected a neuprim.core.data.PointCloud")
    found = len(cloud.means) if isinstance(cloud.means, Tensor) and cloud.means.dim() else 0
    if found > count:
        raise DatasetError(f"{where}: found {found} points; expected at most {count}")
    _floats(f"{where}: means", cloud.means, (found, 3))
    _floats(f"{where}: colors", cloud.colors, (found, dataset.channels))
    for name, columns in (("axes", (3,)), ("quats", (4,)), ("alphas", ()), ("deviations", (3,))):
        if getattr(cloud, name) is not None:
            _floats(f"{where}: {name}", getattr(cloud, name), (found, *columns))
    for name, value in cloud.conditions.items():
        _floats(f"{where}: condition {name!r}", value, (found,))


def check_samples(samples: PointSamples, dataset: Dataset) -> None:
    """Check shapes and dtypes of points to learn from, in every step; raise DatasetError."""
    where = f"{dataset.name}: points"
    if not isinstance(samples, PointSamples):
        raise DatasetError(f"{where}: drew {_described(samples)}; expected a neuprim.core.data.PointSamples")
    count = len(samples.sigma) if isinstance(samples.sigma, Tensor) and samples.sigma.dim() else 0
    if count == 0:
        _refuse(f"{where} of {samples.name}: sigma", samples.sigma, torch.float32, ("M",), ", M at least 1")
    wanted = [
        ("points", samples.points, (count, 3)),
        ("sigma", samples.sigma, (count,)),
        ("source", samples.source, (count, dataset.channels)),
        *((f"component {name}", value, (count,)) for name, (value, _) in samples.components.items()),
    ]
    for name, value, shape in wanted:
        if not (_is(value, torch.float32) and value is not None and tuple(value.shape) == shape) and not (
            name == "source" and value is None
        ):
            _refuse(f"{where} of {samples.name}: {name}", value, torch.float32, shape)
    scales = {name: getattr(samples, name) for name in ("sigma_scale", "source_scale")}
    scales |= {f"scale of component {name}": scale for name, (_, scale) in samples.components.items()}
    for name, number in scales.items():
        if not isinstance(number, (int, float)) or not 0 < number < float("inf"):
            raise DatasetError(f"{where} of {samples.name}: {name} is {number!r}; expected a positive number")


def get_extra(dataset: Dataset, kind: type[Extra]) -> Extra | None:
    """Return ``dataset.extra``; raise DatasetError if it is neither None nor of class ``kind``."""
    extra = dataset.extra
    if extra is None or isinstance(extra, kind):
        return extra
    raise DatasetError(
        f"{dataset.name}: extra is {_described(extra)}; expected a {kind.__module__}.{kind.__qualname__}, or None"
    )


# ---------------------------------------------------------------- members and views


def _members(dataset: Dataset) -> None:
    who = str(dataset.name)
    for split in ("train", "test"):
        value = getattr(dataset, split)
        if not isinstance(value, ViewSet):
            raise DatasetError(f"{who}: {split} is {_described(value)}; expected a neuprim.core.data.ViewSet")
    if not callable(dataset.start):
        raise DatasetError(
            f"{who}: start is {_described(dataset.start)}; expected a function of (views, count, generator)"
        )
    channels, extent, bounds = dataset.channels, dataset.extent, dataset.bounds
    if not isinstance(channels, int) or channels < 1:
        raise DatasetError(f"{who}: channels is {channels!r}; expected a whole number, 1 or more")
    _one_of(f"{who}: color_space", dataset.color_space, ("srgb", "linear"))
    _one_of(f"{who}: data_source", dataset.data_source, get_args(DataSource))
    if not isinstance(extent, (int, float)) or not 0 < extent < float("inf"):
        raise DatasetError(f"{who}: extent is {extent!r}; expected a positive number of scene units")
    _floats(f"{who}: background", dataset.background, (channels,), f", one number for each of the {channels} channels")
    _floats(f"{who}: up", dataset.up, (3,))
    _floats(f"{who}: center", dataset.center, (3,))
    if bounds is not None:
        _floats(f"{who}: bounds", bounds, (2, 3), ", lower and upper corner, or None")
    if not isinstance(dataset.points, PointSupervision | None):
        raise DatasetError(
            f"{who}: points is {_described(dataset.points)}; expected a neuprim.core.data.PointSupervision, or None"
        )
    if not isinstance(dataset.exposure, (int, float)) or not 0 < dataset.exposure < float("inf"):
        raise DatasetError(f"{who}: exposure is {dataset.exposure!r}; expected a positive number")
    if not isinstance(dataset.world, World):
        raise DatasetError(f"{who}: world is {_described(dataset.world)}; expected a {World.__module__}.World")
    dataset.world.validate(f"{who}: world")
    if not isinstance(dataset.placement, Placement | None):
        raise DatasetError(
            f"{who}: placement is {_described(dataset.placement)}; expected a {Placement.__module__}.Placement, or None"
        )


def _view(view: View, where: str, conditions: Sequence[ConditionSpec]) -> None:
    if not isinstance(view, View):
        raise DatasetError(f"{where}: found {_described(view)}; expected a neuprim.core.data.View")
    where = f"{where} ({view.name})" if view.name else where
    if not isinstance(view.name, str) or not view.name:
        raise DatasetError(f"{where}: name is {view.name!r}; expected text")
    _camera(view.camera, where)
    for spec in conditions:
        if spec.name not in view.conditions:
            there = ", ".join(sorted(view.conditions)) or "none"
            raise DatasetError(f"{where}: condition {spec.name!r} is missing; found {there}, the task needs it")
        value, shape = view.conditions[spec.name], tuple(spec.shape)
        if not isinstance(value, Tensor) or tuple(value.shape) != shape:
            _refuse(f"{where}: condition {spec.name!r}", value, torch.float32, shape)
        _finite(value, f"{where}: condition {spec.name!r}")
        low, high = torch.tensor(spec.range, dtype=value.dtype if value.is_floating_point() else torch.float64)
        outside = (value < low) | (value > high)
        if spec.strict and bool(outside.any()):
            raise DatasetError(
                f"{where}: condition {spec.name!r} holds {float(value[outside].flatten()[0]):g}; expected "
                f"{low:g} to {high:g}, its range"
            )


def _camera(camera: AnyCamera, where: str) -> None:
    if isinstance(camera, Camera):
        if not isinstance(camera.viewmat, Tensor):
            raise DatasetError(f"{where}: camera: viewmat is {_described(camera.viewmat)}; expected a tensor (4, 4)")
        try:
            camera.validate(f"{where}: camera")
        except DataError as error:
            raise DatasetError(str(error)) from error
        except (TypeError, ValueError, RuntimeError) as error:
            raise DatasetError(
                f"{where}: camera is {camera!r}; expected numbers ({error})".replace("\n", " ")
            ) from error
    elif not isinstance(camera, RayCamera):
        raise DatasetError(f"{where}: camera is {_described(camera)}; expected a neuprim.core.cameras.Camera")


# ---------------------------------------------------------------- comparing


def _is(value: Any, dtype: torch.dtype) -> bool:
    return isinstance(value, Tensor) and value.dtype == dtype


def _floats(where: str, value: Any, shape: tuple[int, ...], more: str = "") -> None:
    """Require finite floating-point numbers of any precision."""
    if not (isinstance(value, Tensor) and value.is_floating_point() and tuple(value.shape) == shape):
        _refuse(where, value, torch.float32, shape, more)
    _finite(value, where)


def _finite(value: Tensor, where: str) -> None:
    bad = ~torch.isfinite(value)
    if bool(bad.any()):
        place = bad.nonzero()[0].tolist()
        first = f", the first at {place}" if place else ""
        raise DatasetError(
            f"{where}: found {int(bad.sum())} values that are NaN or infinite{first}; expected finite numbers"
        )


def _one_of(where: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise DatasetError(f"{where} is {value!r}; expected {' or '.join(choices)}")


def _refuse(where: str, value: Any, dtype: torch.dtype, shape: tuple[int | str, ...], more: str = "") -> None:
    raise DatasetError(f"{where} is {_described(value)}; expected {_name(dtype)} {shape}{more}")


def _described(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{_name(value.dtype)} {tuple(value.shape)}"
    return (
        "None"
        if value is None
        else f"a {type(value).__module__}.{type(value).__qualname__}".replace("a builtins.", "a ")
    )


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
