"""Load ``scene=lit_solids``: the generated images, and what only a generated scene knows of its pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neuprim.core.data import Clip, Dataset
from neuprim.core.data.image_views import ImageViews
from neuprim.core.data.posed_images import HoldOut, frame_in_scene
from neuprim.core.errors import DataError
from neuprim.core.io.images import read_image
from neuprim.core.task import SceneContext
from neuprim.core.validation import Accepts, validate
from neuprim.scenes.lit import NEAR_LIGHTS, PARTS, LitSettings, generate_lit_solids
from neuprim.tasks.relight import olat
from neuprim.tasks.relight.lighting import Lighting

_Background = Annotated[
    str, Accepts(("black", "random").__contains__, "black or random: nothing but the light shines here")
]


@dataclass(frozen=True)
class LitSolidsSettings(LitSettings):
    """Settings of ``scene=lit_solids``: what changes the images, and how they are read.

    Attributes:
        background: "black", or "random": training composites random colours.
        hold_out: n: every n-th training view is the test split, for tuning; 0 for the split that is drawn.
    """

    background: _Background = "black"
    hold_out: HoldOut = 0


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=lit_solids``: drawn on first use, read from ``context.cache_dir`` afterwards.

    Raises:
        ConfigError: unknown setting or impossible value.
        DataError: the cache directory cannot be written.
    """
    options = validate(LitSolidsSettings, settings, "scene")
    drawn = LitSettings(**{f.name: getattr(options, f.name) for f in fields(LitSettings)})
    folder = generate_lit_solids(drawn, context.cache_dir, context.progress)
    reading = {"background": options.background, "hold_out": options.hold_out}
    dataset = olat.load({"path": str(folder), "falloff": "inverse_square", **reading}, context)
    rays = drawn.supersampling
    return replace(
        dataset,
        name="lit_solids",
        data_source="generated",
        background=torch.zeros(3),
        bounds=torch.tensor([[-1.0, -1.0, -0.65], [1.0, 1.0, 1.0]]),
        downsampling=f"rendered at {drawn.size}x{drawn.size}, {rays}x{rays} rays per pixel",
        extra=_lighting(dataset, folder),
    )


def _lighting(dataset: Dataset, folder: Path) -> Lighting:
    """Pixel classes, parts of the test split, the baselines "perfect shading without cast shadows" and "the nearest of
    25 training lights at the same camera", and a film of one new camera under a light that goes round."""
    test = dataset.test
    assert isinstance(test, ImageViews)  # as posed_images makes them
    baselines = {"no_cast_shadows": partial(_read_companion, test, "unshadowed.exr")}
    if _companion(test, "nearest.exr", 0).is_file():  # not where training views are held out
        baselines[f"nearest_light_of_{NEAR_LIGHTS}"] = partial(_read_companion, test, "nearest.exr")
    views = olat.read_split(folder, "circle", olat.OlatSettings(path=folder))
    circle = ImageViews([frame_in_scene(f, dataset.world, ("light",)) for f in views], to_linear=True)
    film = Clip("light_round", range(len(circle)), 12.0, circle)
    return Lighting("inverse_square", partial(read_classes, test), PARTS, baselines, (film,))


def read_classes(views: ImageViews, index: int) -> Tensor:
    """(H, W) uint8 pixel classes of a view, indices of :data:`~neuprim.scenes.PIXEL_CLASSES`.

    Raises:
        DataError: the file is missing or damaged.
    """
    path = _companion(views, "classes.png", index)
    try:
        with Image.open(path, formats=("PNG",)) as image:
            return torch.from_numpy(np.array(image))
    except (OSError, SyntaxError) as error:
        raise DataError(f"{path}: damaged ({error}); delete its folder to draw the scene again") from None


def _read_companion(views: ImageViews, ending: str, index: int) -> Tensor:
    """(H, W, 3) a further image of a view, linear light over the exposure."""
    camera = views.view(index).camera
    return read_image(_companion(views, ending, index), (camera.width, camera.height))[..., :3].float()


def _companion(views: ImageViews, ending: str, index: int) -> Path:
    file = views.file(index)
    return file.with_name(f"{file.stem}_{ending}")
