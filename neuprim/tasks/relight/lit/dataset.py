"""The built-in scene as a data set: what :mod:`.generate` wrote, and what only a generated scene can tell about a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neuprim.core.checked import Accepts, checked
from neuprim.core.data import Clip
from neuprim.core.data.settings import HoldOut
from neuprim.core.data.views import ImageViews
from neuprim.core.errors import DataError
from neuprim.core.io.images import read_image
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import SceneContext
from neuprim.tasks.relight import olat
from neuprim.tasks.relight.data import PointLit
from neuprim.tasks.relight.lit.generate import LitSettings, generate
from neuprim.tasks.relight.lit.rig import NEAR_LIGHTS, PARTS
from neuprim.tasks.relight.measure import class_errors, class_shares, scores

__all__ = ["LitSolids", "LitSolidsSettings", "load"]

_BLACK_OR_RANDOM = ("black", "random")


@dataclass(frozen=True)
class LitSolidsSettings(LitSettings):
    """What the user may set for ``scene=lit_solids``: what changes the images, and how they are read.

    Attributes:
        background: "black", or "random": training composites random colours.
        hold_out: n: every n-th training view is the test split, for tuning; 0 for the split that is drawn.
    """

    background: Annotated[str, Accepts(_BLACK_OR_RANDOM.__contains__, "black or random: nothing but the light shines here")] = "black"
    hold_out: HoldOut = 0


def load(settings: Mapping[str, Any], context: SceneContext) -> LitSolids:
    """The data set of ``scene=lit_solids``, drawn on first use and read from ``context.cache_dir`` afterwards.

    Raises:
        ConfigError: unknown setting or impossible value.
        DataError: the cache directory cannot be written.
    """
    asked = checked(LitSolidsSettings, settings, "scene")  # before a minute of drawing
    drawn = LitSettings(**{f.name: getattr(asked, f.name) for f in fields(LitSettings)})
    reading = {"background": asked.background, "hold_out": asked.hold_out}
    folder = generate(drawn, context.cache_dir, context.progress)
    dataset = olat.read({"path": str(folder), "falloff": "inverse_square", **reading}, context, LitSolids)
    dataset.name, dataset.data_source, dataset.background = "lit_solids", "generated", torch.zeros(3)
    dataset.circle = ImageViews(olat.read_split(folder, "circle"), to_linear=True)
    dataset.bounds = torch.tensor([[-1.0, -1.0, -0.65], [1.0, 1.0, 1.0]])
    dataset.downsampling = f"rendered at {drawn.size}x{drawn.size}, {drawn.supersampling}x{drawn.supersampling} rays per pixel"
    return dataset


class LitSolids(PointLit):
    """The built-in scene.

    Attributes:
        circle: one new camera under a light that goes round; not part of the test split.
    """

    circle: ImageViews

    def classes(self, index: int, views: ImageViews | None = None) -> Tensor:
        """(H, W) uint8 pixel classes of a test view, or of one of other ``views`` of this data set; see :mod:`.generate`.

        Raises:
            DataError: the file is missing or damaged.
        """
        path = _beside((views or self.test).file(index), "classes.png")
        try:
            with Image.open(path, formats=("PNG",)) as image:
                return torch.from_numpy(np.array(image))
        except (OSError, SyntaxError) as error:
            raise DataError(f"{path}: damaged ({error}); delete its folder to draw the scene again") from None

    def unshadowed(self, index: int) -> Tensor:
        """(H, W, 3) a test view as if nothing cast a shadow, linear light over the exposure."""
        return self._companion(index, "unshadowed.exr")

    def nearest_light(self, index: int) -> Tensor:
        """(H, W, 3) a test view under the nearest of the first 25 training lights, linear light over the exposure."""
        return self._companion(index, "nearest.exr")

    def _judged(self, index: int, rendered: Tensor, truth: Tensor, structure: bool) -> dict[str, float]:
        """Beside the scores, the errors of each pixel class, and the PSNR again under the name of the view's part of the test split."""
        result = scores(rendered, truth, structure)
        part = next((p for p in PARTS if self.test.view(index).name.startswith(p)), None)
        if part is not None:
            result[f"psnr_linear_clamped_{part}"] = result["psnr_linear_clamped"]
        return result | class_errors(rendered, truth, self.classes(index))

    def diagnose(self, model: Primitives) -> dict[str, Any]:
        """Also the share of each pixel class in the test split, in percent of the pixels that show matter."""
        shares = class_shares([self.classes(i) for i in range(len(self.test))])
        return {**super().diagnose(model), "class_percent": shares}

    def baselines(self) -> dict[str, dict[str, Any]]:
        """Black; the nearest of 25 training lights at the same camera; perfect shading without cast shadows."""
        result = super().baselines() | {"no_cast_shadows": self.guessed(lambda i, _: self.unshadowed(i))}
        if _beside(self.test.file(0), "nearest.exr").is_file():  # not where training views are held out
            result[f"nearest_light_of_{NEAR_LIGHTS}"] = self.guessed(lambda i, _: self.nearest_light(i))
        return result

    def clips(self) -> list[Clip]:
        """A light that goes round, seen by one new camera."""
        return [Clip("light_round", range(len(self.circle)), 12.0, self.circle)]

    def _companion(self, index: int, ending: str) -> Tensor:
        camera = self.test.view(index).camera
        return read_image(_beside(self.test.file(index), ending), (camera.width, camera.height))[..., :3].float()


def _beside(file: Path, ending: str) -> Path:
    return file.with_name(f"{file.stem}_{ending}")
