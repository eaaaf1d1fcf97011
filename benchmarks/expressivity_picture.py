"""Figure 9 of the paper from fitted models: render, error, a slice through the density, and the primitives in colour.

    python benchmarks/expressivity_picture.py TARGET.png ROWS RUN_DIR [RUN_DIR ...]

The run directories are those of benchmarks/expressivity.py, ROWS of each scene one after another. A fitted model has no
resolution, so one that was trained on smaller images is drawn as large as the others, beside the truth at that size.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuprim.core.channels import Channels
from neuprim.core.data import Dataset, View
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.fields import Constant
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered, Primitives
from neuprim.core.render import render_lowered
from neuprim.core.render.reference.backend import pixel_directions
from neuprim.report.pictures import ERROR_SCALE
from neuprim.runs.measure import draw
from neuprim.runs.open import load_dataset, load_run

SIZE = 200
"""Pixels on a side of every panel; chair_200's own size, and what solids is ray-cast at for the truth."""
LIGHT = (0.3, -0.5, -0.8)
"""Direction towards the light in camera axes, for the shaded ellipsoids: from above, behind the camera's right
shoulder."""
GAUSSIAN_REACH = 0.5
"""Share of a Gaussian's support that is drawn: its density has fallen to a third there, at 1.5 of 3 standard
deviations."""
COLUMNS = ("ground truth", "render", f"error, 0 to {ERROR_SCALE}", "slice through σ", "one colour each", "ellipsoids")


@dataclass(frozen=True)
class Panels:
    """One row of the figure; images (H, W, 3) float, error and slice (H, W)."""

    title: str
    truth: Tensor
    render: Tensor
    error: Tensor
    slice: Tensor
    coloured: Tensor
    ellipsoids: Tensor


def title(model: Primitives) -> str:
    if isinstance(model.density, GaussianDensity):
        kind = "Gaussian"
    else:
        assert isinstance(model.density, CosineDensity)
        kind = f"K = {model.density.neurons}, p = {model.density.edge}" + (", gain" if model.density.gain else "")
    return f"{kind}\n{model.count} primitives\n{model.count * model.parameters_per_primitive} parameters"


def full_size(run_dir: Path) -> tuple[Primitives, Dataset, Any]:
    """Model and data set of a run, the data set at the size of the panels."""
    config, task, model, _ = load_run(run_dir)
    key, value = ("size", SIZE) if "size" in config.scene else ("downsample", 1)
    config = replace(config, scene={**config.scene, key: value})
    return model, load_dataset(config, task), config.renderer


def panels(run_dir: Path) -> Panels:
    model, dataset, settings = full_size(run_dir)
    index = len(dataset.test) // 2
    view, truth = dataset.test.view(index), dataset.test.pixels(index).over(dataset.background)
    rendered = draw(model, view, settings, dataset.background)
    with torch.no_grad():
        random = torch.rand(model.count, 3, generator=torch.Generator().manual_seed(0)) * 0.85 + 0.1
        lowered = model.lower(view.camera, view.conditions)
        coloured = render_lowered(
            Lowered(lowered.geometry, lowered.density, Constant(random)), view.camera, settings, torch.ones(3)
        ).rgb
        sigma = density_slice(model, view, dataset.center)
        reach = GAUSSIAN_REACH if isinstance(model.density, GaussianDensity) else 1.0
        shaded = ellipsoids(model.geometry, view, random, reach)
    error = (rendered - truth).abs().mean(-1)
    shown = Channels(color_space=dataset.color_space).display
    return Panels(title(model), shown(truth), shown(rendered), error, sigma, coloured, shaded)


def density_slice(model: Primitives, view: View, center: Tensor) -> Tensor:
    """(H, W) sum of all primitives' density, 1/scene unit, on the plane through ``center`` that faces the camera.

    Each pixel shows the point where its ray meets the plane, so the slice lies on top of the render. Sums below zero
    are drawn as zero.
    """
    camera = view.camera
    world_to_camera = camera.viewmat.double()
    depth = float((world_to_camera[:3, :3] @ center.double() + world_to_camera[:3, 3])[2])
    d = pixel_directions(camera).reshape(-1, 3)
    points = camera.position.double() + (d * (depth / d[:, 2:])) @ world_to_camera[:3, :3]
    wide = {k: v.detach().double() for k, v in model.of(model.density).items()}
    g = Geometry(
        *(t.detach().double() for t in (model.geometry.means, model.geometry.log_scales, model.geometry.quats))
    )
    sigma = torch.zeros(len(points), dtype=torch.float64)
    for row in range(g.count):
        local = (points - g.means[row]) @ g.rotations[row] / g.scales[row]
        inside = ((local * local).sum(-1) < 1).nonzero()[:, 0]
        prim = torch.full((len(inside),), row)
        sigma[inside] += model.density.density(wide, g, prim, points[inside], view.conditions)
    return sigma.clamp_min(0).reshape(camera.height, camera.width)


def ellipsoids(geometry: Geometry, view: View, colors: Tensor, reach: float) -> Tensor:
    """(H, W, 3) the ellipsoids, ``reach`` times their support, as opaque shaded solids: the nearest one at every pixel,
    on white."""
    camera = view.camera
    rotation = camera.viewmat[:3, :3].double()
    d = pixel_directions(camera).reshape(-1, 3) @ rotation
    light = torch.tensor(LIGHT, dtype=torch.float64) @ rotation
    light = light / light.norm()
    nearest = torch.full((len(d),), torch.inf, dtype=torch.float64)
    image = torch.ones(len(d), 3, dtype=torch.float64)
    rotations, scales = geometry.rotations.double(), geometry.scales.double() * reach
    for row in range(geometry.count):
        p = (camera.position.double() - geometry.means[row].double()) @ rotations[row] / scales[row]
        v = d @ rotations[row] / scales[row]
        a = (v * v).sum(1)
        middle = -(v @ p) / a
        closest = p + middle[:, None] * v
        D = 1 - (closest * closest).sum(1)
        t = middle - (D.clamp_min(0) / a).sqrt()
        wins = (D > 0) & (t > 0) & (t < nearest)
        nearest[wins] = t[wins]
        normal = ((p + t[wins][:, None] * v[wins]) / scales[row]) @ rotations[row].T
        shade = 0.35 + 0.65 * ((normal / normal.norm(dim=1, keepdim=True)) @ light).clamp_min(0)
        image[wins] = shade[:, None] * colors[row].double()
    return image.reshape(camera.height, camera.width, 3)


def draw_figure(runs: list[Path], target: Path, per_scene: int) -> None:
    """``per_scene`` rows of each scene. Error maps share the report's scale; slices share one scale per scene, printed
    beside them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = [panels(run) for run in runs]
    figure, axes = plt.subplots(
        len(rows), len(COLUMNS), figsize=(12.6, 2.05 * len(rows) + 0.35), squeeze=False, layout="constrained"
    )
    for r, row in enumerate(rows):
        scene = rows[per_scene * (r // per_scene) : per_scene * (r // per_scene + 1)]
        top = max(float(torch.quantile(p.slice[p.slice > 0], 0.9)) for p in scene if bool((p.slice > 0).any()))
        shown: tuple[tuple[Tensor, dict[str, Any]], ...] = (
            (row.truth, {}), (row.render, {}), (row.error, {"cmap": "inferno", "vmin": 0, "vmax": ERROR_SCALE}),
            (row.slice, {"cmap": "viridis", "vmin": 0, "vmax": top}), (row.coloured, {}), (row.ellipsoids, {}),
        )  # fmt: skip
        for c, (image, how) in enumerate(shown):
            axis = axes[r][c]
            axis.set_xticks([])
            axis.set_yticks([])
            pixels: NDArray[Any] = np.asarray(image.clamp(0, 1) if image.dim() == 3 else image)
            drawn = axis.imshow(pixels, interpolation="nearest", **how)
            if r % per_scene == 0:
                axis.set_title(COLUMNS[c] + (f", 0 to {top:.0f}" if c == 3 else ""), fontsize=9)
            if how:
                figure.colorbar(drawn, ax=axis, fraction=0.046, pad=0.02).ax.tick_params(labelsize=6)
        axes[r][0].set_ylabel(row.title, fontsize=8)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    if len(sys.argv) < 4 or not sys.argv[2].isdigit() or (len(sys.argv) - 3) % max(int(sys.argv[2]), 1):
        sys.exit(__doc__)
    draw_figure([Path(text) for text in sys.argv[3:]], Path(sys.argv[1]), int(sys.argv[2]))
