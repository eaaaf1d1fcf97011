"""Create the initial model of a training: primitives at the starting points of a data set."""

from __future__ import annotations

from pathlib import Path

import torch
from scipy.spatial import cKDTree

from neuprim.core.data import Dataset, PointCloud
from neuprim.core.data.dataset_check import check_points
from neuprim.core.data.initial import draw_points, surrounding_points
from neuprim.core.data.points_file import COMPRESSED, READABLE, read_points
from neuprim.core.data.starting_points import GIVE_POINTS, count_seeing_views
from neuprim.core.errors import ConfigError, DataError, nearest
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render.near_plane import near_plane_extent
from neuprim.core.train.settings import ModelSettings

__all__ = ["initial_model_to_train"]

_USUAL_OPACITY = 0.5
"""Opacity of Gaussians from files that have sizes but no opacities."""


def initial_model_to_train(
    density: DensityField, colour: ColourField, dataset: Dataset, settings: ModelSettings, seed: int
) -> Primitives:
    """Return an untrained model with primitives at the starting points of a data set.

    A primitive's size is the RMS distance from its point to the 3 nearest points. ``model.init.points`` chooses the
    points: "matter" (the points of the data set), "box" (random in the data set's box), or a .ply file of points or a
    .ply or .spz file of 3D Gaussians, in the coordinate system of the data files. Gaussians also set sizes,
    orientations and opacities.
    ``model.init.scale`` multiplies all sizes. ``model.init.surroundings``, 0 by default, is the fraction of the
    primitives placed where photographs show something and the data set has no points.

    Raises:
        ConfigError: a setting does not exist or has an invalid value.
        DataError: the data set has no starting point, or the file is damaged.
    """
    for key in settings.init:
        known = ("scale", "points", "surroundings", *density.init_settings, *colour.init_settings)
        if key not in known:
            raise ConfigError(f"model.init.{key}: no such setting{nearest(key, known)}")
    generator = torch.Generator().manual_seed(seed)
    where = settings.init.get("points", "matter")
    if isinstance(where, str) and where.lower().endswith((*READABLE, *COMPRESSED)):
        points = read_points(Path(where).expanduser(), dataset.channels, dataset.color_space).within(dataset.world)
        cloud = draw_points(points, settings.count, generator)
    elif where in ("matter", "box"):
        cloud = (dataset.uniform_points if where == "box" else dataset.initial_points)(settings.count, generator)
        cloud = _add_initial_surroundings(cloud, dataset, settings, generator)
    else:
        raise ConfigError(f"model.init.points={where!r}: expected matter, box or a .ply or .spz file")
    check_points(cloud, settings.count, dataset)
    if len(cloud.means) == 0:
        raise DataError(f"{dataset.name}: no starting points found; expected points or images with visible content")
    if not bool((count_seeing_views(dataset.train, cloud.means) > 0).any()):
        raise DataError(
            f"{dataset.name}: none of {len(cloud.means)} starting points is in the image of a training camera; "
            f"{GIVE_POINTS}"
        )
    cameras = [dataset.train.view(i).camera for i in range(len(dataset.train))]
    extent = near_plane_extent(dataset.extent, cloud.means, cameras)
    if len(cloud.means) == 1:
        scales = torch.full((1,), 0.1 * extent)
    else:
        neighbours = min(3, len(cloud.means) - 1)
        distance = torch.from_numpy(cKDTree(cloud.means.numpy()).query(cloud.means.numpy(), k=neighbours + 1)[0][:, 1:])
        scales = distance.square().mean(dim=1).sqrt().clamp_min(1e-6 * extent).float()
    context = InitContext(
        cloud.means.float(), scales, cloud.colors.float(), generator, settings.init, cloud.conditions,
        steps=cloud.steps, velocities=cloud.velocities,
    )  # fmt: skip
    factor = context.number("scale", 1.0, 0)
    context.scales, context.quats, context.alphas = scales * factor, cloud.quats, cloud.alphas
    axes = cloud.axes
    if cloud.deviations is not None:
        opacities = torch.full((len(cloud.means),), _USUAL_OPACITY) if cloud.alphas is None else cloud.alphas
        support, opacities = density.from_gaussians(opacities.clamp(0, 1))
        axes = cloud.deviations * support[:, None]
        context.alphas = None if cloud.alphas is None else opacities
    if axes is not None:
        context.axes = axes.clamp_min(1e-6 * extent) * factor
    return Primitives.initialise(density, colour, context)


def _add_initial_surroundings(
    cloud: PointCloud, dataset: Dataset, settings: ModelSettings, generator: torch.Generator
) -> PointCloud:
    """Return ``cloud`` with some points replaced by points on visible surfaces where ``cloud`` has no points.

    The setting ``model.init.surroundings`` is the fraction to replace.
    """
    share = settings.init.get("surroundings", 0.0)
    if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share < 1:
        raise ConfigError(
            f"model.init.surroundings={share!r}: expected a share of the primitives, at least 0 and below 1"
        )
    if not share:
        return cloud
    if cloud.conditions:
        named = ", ".join(cloud.conditions)
        raise ConfigError(
            f"model.init.surroundings={share!r}: {dataset.name} changes with {named}; "
            "expected a static scene, or model.init.surroundings=0"
        )
    own = draw_points(cloud, min(len(cloud.means), round((1.0 - share) * settings.count)), generator)
    more = surrounding_points(dataset.train, own, settings.count - len(own.means), generator)
    return PointCloud(torch.cat([own.means, more.means]), torch.cat([own.colors, more.colors]))
