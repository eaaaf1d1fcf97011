"""Check that a data set from a loader follows the rules of :class:`~neuprim.core.data.dataset.Dataset`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, DataSource, Pixels, PointCloud, PointSamples, PointSupervision, View, ViewSet
from neuprim.core.errors import DataError
from neuprim.core.model.fields import CHANNEL, ConditionSpec
from neuprim.core.volumes.density_truth import DensityGridPlacement

__all__ = ["DatasetError", "check_dataset_views", "get_extra"]

Extra = TypeVar("Extra")


class DatasetError(DataError):
    """A loader returned a data set that breaks the rules of :class:`~neuprim.core.data.dataset.Dataset`."""


def check_dataset_views(dataset: Dataset, conditions: Sequence[ConditionSpec]) -> None:
    """Raise DatasetError unless a data set is valid.

    The function checks the attributes, all views, and the pixels of the first view of each split.
    """
    _check_dataset_values(dataset)
    for split in ("train", "test"):
        views: ViewSet = getattr(dataset, split)
        if len(views) == 0:
            raise DatasetError(f"{dataset.name}: the {'training' if split == 'train' else split} split is empty")
        for i in range(len(views)):
            _check_dataset_view(views.view(i), f"{split} view {i}", conditions)
        view, pixels = views.view(0), views.pixels(0)
        check_pixels(split, view, pixels, dataset.channels)
        for name, value in (("rgb", pixels.rgb), ("alpha", pixels.alpha)):
            if value is not None:
                _check_finite_dataset_values(value, f"{split} view {view.name}: {name}")


def check_pixels(split: str, view: View, pixels: Pixels, channels: int) -> None:
    """Check shapes and dtypes of a view's pixels against its camera; raise DatasetError naming the ``split``."""
    where, size = f"{split} view {view.name}", (view.camera.height, view.camera.width)
    _check_dataset_instance(f"{where}: pixels", pixels, Pixels)
    _check_dataset_tensor(f"{where}: rgb", pixels.rgb, torch.float32, (*size, channels), ", rows x columns x channels")
    if pixels.alpha is not None:
        _check_dataset_tensor(f"{where}: alpha", pixels.alpha, torch.float32, size, ", rows x columns, or None")
    if pixels.mask is not None:
        check_mask(split, view, pixels.mask)


def check_mask(split: str, view: View, mask: Tensor) -> None:
    """Check shape and dtype of a view's mask against its camera; raise DatasetError naming the ``split``."""
    size = (view.camera.height, view.camera.width)
    _check_dataset_tensor(f"{split} view {view.name}: mask", mask, torch.bool, size, ", rows x columns, or None")


def check_points(cloud: PointCloud, count: int, dataset: Dataset) -> None:
    """Raise DatasetError unless starting points are valid and at most ``count``, the requested number."""
    where = f"{dataset.name}: starting points"
    _check_dataset_instance(where, cloud, PointCloud)
    found = len(cloud.means) if isinstance(cloud.means, Tensor) and cloud.means.dim() else 0
    if found > count:
        raise DatasetError(f"{where}: found {found} points; expected at most {count}")
    _check_finite_dataset_tensor(f"{where}: means", cloud.means, (found, 3))
    _check_finite_dataset_tensor(f"{where}: colors", cloud.colors, (found, dataset.channels))
    for name, columns in (("axes", (3,)), ("quats", (4,)), ("alphas", ()), ("deviations", (3,)), ("velocities", (3,))):
        if getattr(cloud, name) is not None:
            _check_finite_dataset_tensor(f"{where}: {name}", getattr(cloud, name), (found, *columns))
    for name, value in cloud.conditions.items():
        _check_finite_dataset_tensor(f"{where}: condition {name!r}", value, (found,))


def check_point_samples(samples: PointSamples, dataset: Dataset) -> None:
    """Raise DatasetError unless ground-truth points have valid shapes and dtypes; called in every training step."""
    _check_dataset_instance(f"{dataset.name}: points", samples, PointSamples)
    where = f"{dataset.name}: points of {samples.name}"
    count = len(samples.sigma) if isinstance(samples.sigma, Tensor) and samples.sigma.dim() else 0
    if count == 0:
        _refuse_dataset_tensor(f"{where}: sigma", samples.sigma, torch.float32, ("M",), ", M at least 1")
    _check_dataset_tensor(f"{where}: points", samples.points, torch.float32, (count, 3))
    _check_dataset_tensor(f"{where}: sigma", samples.sigma, torch.float32, (count,))
    if samples.source is not None:
        _check_dataset_tensor(f"{where}: source", samples.source, torch.float32, (count, dataset.channels))
    scales = {"sigma_scale": samples.sigma_scale, "source_scale": samples.source_scale}
    for name, (value, scale) in samples.components.items():
        columns = value.shape[1:] if name.startswith(CHANNEL) else ()
        _check_dataset_tensor(f"{where}: component {name}", value, torch.float32, (count, *columns))
        scales[f"scale of component {name}"] = scale
    for name, scale in scales.items():
        _check_positive_dataset_number(f"{where}: {name}", scale)


def get_extra(dataset: Dataset, kind: type[Extra]) -> Extra | None:
    """Return ``dataset.extra``; raise DatasetError if it is neither None nor an instance of ``kind``."""
    if dataset.extra is not None:
        _check_dataset_instance(f"{dataset.name}: extra", dataset.extra, kind, ", or None")
    return dataset.extra  # type: ignore[return-value]


def _check_dataset_values(dataset: Dataset) -> None:
    who, channels = str(dataset.name), dataset.channels
    _check_dataset_instance(f"{who}: train", dataset.train, ViewSet)
    _check_dataset_instance(f"{who}: test", dataset.test, ViewSet)
    if not callable(dataset.start):
        found = _describe_dataset_value(dataset.start)
        raise DatasetError(f"{who}: start is {found}; expected a function of (views, count, generator)")
    if not isinstance(channels, int) or channels < 1:
        raise DatasetError(f"{who}: channels is {channels!r}; expected a whole number, 1 or more")
    for name, choices in (("color_space", ("srgb", "linear")), ("data_source", get_args(DataSource))):
        if getattr(dataset, name) not in choices:
            raise DatasetError(f"{who}: {name} is {getattr(dataset, name)!r}; expected {' or '.join(choices)}")
    _check_positive_dataset_number(f"{who}: extent", dataset.extent, " of scene units")
    each = f", one number for each of the {channels} channels"
    _check_finite_dataset_tensor(f"{who}: background", dataset.background, (channels,), each)
    _check_finite_dataset_tensor(f"{who}: up", dataset.up, (3,))
    _check_finite_dataset_tensor(f"{who}: center", dataset.center, (3,))
    if dataset.bounds is not None:
        _check_finite_dataset_tensor(f"{who}: bounds", dataset.bounds, (2, 3), ", lower and upper corner, or None")
    _check_positive_dataset_number(f"{who}: exposure", dataset.exposure)
    _check_dataset_instance(f"{who}: world", dataset.world, World)
    dataset.world.validate(f"{who}: world")
    for name, kind in (("points", PointSupervision), ("placement", DensityGridPlacement)):
        if getattr(dataset, name) is not None:
            _check_dataset_instance(f"{who}: {name}", getattr(dataset, name), kind, ", or None")


def _check_dataset_view(view: View, where: str, conditions: Sequence[ConditionSpec]) -> None:
    _check_dataset_instance(where, view, View)
    where = f"{where} ({view.name})" if view.name else where
    if not isinstance(view.name, str) or not view.name:
        raise DatasetError(f"{where}: name is {view.name!r}; expected nonempty text")
    _check_dataset_camera(view.camera, where)
    for spec in conditions:
        what = f"{where}: condition {spec.name!r}"
        if spec.name not in view.conditions:
            there = ", ".join(sorted(view.conditions)) or "none"
            raise DatasetError(f"{what} is missing, but the task needs this condition; conditions found: {there}")
        value, shape = view.conditions[spec.name], tuple(spec.shape)
        if not isinstance(value, Tensor) or tuple(value.shape) != shape:
            _refuse_dataset_tensor(what, value, torch.float32, shape)
        _check_finite_dataset_values(value, what)
        low, high = torch.tensor(spec.range, dtype=value.dtype if value.is_floating_point() else torch.float64)
        outside = (value < low) | (value > high)
        if spec.strict and bool(outside.any()):
            first = float(value[outside].flatten()[0])
            expected = f"{low:g} to {high:g}, the range of this condition"
            raise DatasetError(f"{what} is {first:g}; expected {expected}")


def _check_dataset_camera(camera: AnyCamera, where: str) -> None:
    if isinstance(camera, RayCamera):
        return
    _check_dataset_instance(f"{where}: camera", camera, Camera)
    if not isinstance(camera.viewmat, Tensor):
        found = _describe_dataset_value(camera.viewmat)
        raise DatasetError(f"{where}: camera: viewmat is {found}; expected a tensor (4, 4)")
    try:
        camera.validate(f"{where}: camera")
    except DataError as error:
        raise DatasetError(str(error)) from error
    except (TypeError, ValueError, RuntimeError) as error:
        text = f"{where}: camera is {camera!r}; expected numbers ({error})"
        raise DatasetError(text.replace("\n", " ")) from error


def _check_dataset_instance(where: str, value: object, kind: type, more: str = "") -> None:
    if not isinstance(value, kind):
        expected = f"{kind.__module__}.{kind.__qualname__}"
        raise DatasetError(f"{where} is {_describe_dataset_value(value)}; expected a {expected}{more}")


def _check_positive_dataset_number(where: str, value: object, more: str = "") -> None:
    if not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise DatasetError(f"{where} is {value!r}; expected a positive number{more}")


def _check_dataset_tensor(where: str, value: Any, dtype: torch.dtype, shape: tuple[int, ...], more: str = "") -> None:
    if not (isinstance(value, Tensor) and value.dtype == dtype and tuple(value.shape) == shape):
        _refuse_dataset_tensor(where, value, dtype, shape, more)


def _check_finite_dataset_tensor(where: str, value: Any, shape: tuple[int, ...], more: str = "") -> None:
    """Raise DatasetError naming ``where`` unless ``value`` is a finite tensor of ``shape``, of any float precision."""
    if not (isinstance(value, Tensor) and value.is_floating_point() and tuple(value.shape) == shape):
        _refuse_dataset_tensor(where, value, torch.float32, shape, more)
    _check_finite_dataset_values(value, where)


def _check_finite_dataset_values(value: Tensor, where: str) -> None:
    bad = ~torch.isfinite(value)
    if bool(bad.any()):
        place = bad.nonzero()[0].tolist()
        found = f"{int(bad.sum())} values that are NaN or infinite" + (f", the first at {place}" if place else "")
        raise DatasetError(f"{where}: found {found}; expected finite numbers")


def _refuse_dataset_tensor(
    where: str, value: Any, dtype: torch.dtype, shape: tuple[int | str, ...], more: str = ""
) -> None:
    expected = str(dtype).removeprefix("torch.")
    raise DatasetError(f"{where} is {_describe_dataset_value(value)}; expected {expected} {shape}{more}")


def _describe_dataset_value(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    kind = type(value)
    return "None" if value is None else f"a {kind.__module__}.{kind.__qualname__}".replace("a builtins.", "a ")
