"""The figures of docs/mathematics.md: one primitive, one ray and the integral of the density along their chord; the
weights of soft edges.

python docs/make_figures.py docs/pictures/chord.png
python docs/make_figures.py docs/pictures/edges.png

Everything in them is computed by the package: the field by `cosine_density`, the integral once by the renderer and once
by summing.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

import neuprim
from neuprim.core.cameras import look_at
from neuprim.core.model.cosine import OMEGA0, cosine_density
from neuprim.core.model.edge import EDGES, NORMS, edge_profile, edge_weight
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry


def primitive() -> tuple[Geometry, Cosine]:
    """An ellipsoid in the plane z = 0, with four neurons."""
    turn = math.radians(25.0)
    quats = torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]], dtype=torch.float64)
    geometry = Geometry(
        torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0.55, 0.55]], dtype=torch.float64).log(), quats
    )
    W1 = torch.tensor(
        [[[0.20, 0.05, 0.0], [0.02, 0.26, 0.0], [0.12, -0.16, 0.0], [0.30, 0.22, 0.0]]], dtype=torch.float64
    )
    b1 = torch.tensor([[0.02, 0.05, -0.01, 0.08]], dtype=torch.float64)
    w2 = torch.tensor([[0.50, 0.42, 0.34, 0.24]], dtype=torch.float64)
    return geometry, Cosine(W1, b1, w2, torch.tensor([0.75], dtype=torch.float64))


def edges(target: Path) -> None:
    """Weights along a chord, and what multiplies a neuron there; both from :mod:`neuprim.core.model.edge`."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.1), layout="constrained")
    u, z = torch.linspace(-1.25, 1.25, 1001, dtype=torch.float64), torch.linspace(0, 14, 1001, dtype=torch.float64)
    for edge in EDGES:
        weight = torch.where(u.abs() < 1, edge_weight(u.square(), edge), torch.zeros_like(u))
        summed = float(weight.sum() * (u[1] - u[0]))
        if abs(summed - NORMS[edge]) > 3e-3:
            sys.exit(f"N_{edge} is {NORMS[edge]}, the sum {summed}")
        left.plot(u, weight, lw=1.8, label=f"p = {edge}")
        right.plot(z, edge_profile(z, edge), lw=1.8, label=f"B$_{edge}$")
    left.plot(u, (-4.5 * u.square()).exp(), color="0.6", lw=1.2, ls="--", label="Gaussian")
    left.set(xlabel="u", title="weight along a chord, (1 − u²)$^p$", xticks=[-1, -0.5, 0, 0.5, 1])
    right.axhline(0, color="0.6", lw=0.8)
    right.set(xlabel="z, the phase's change over half a chord (rad)", title="what multiplies a neuron")
    for axes in (left, right):
        axes.legend(frameon=False, loc="lower center" if axes is left else "upper right", fontsize=8)
    figure.savefig(target, dpi=130)


def chord(target: Path) -> None:
    geometry, form = primitive()
    origin, aim = np.array([-2.1, -0.55, 0.0]), np.array([0.1, 0.12, 0.0])
    d = (aim - origin) / np.linalg.norm(aim - origin)

    R, s = geometry.rotations[0].numpy(), geometry.scales[0].numpy()
    p, v = R.T @ origin / s, R.T @ d / s
    t_m = -(p @ v) / (v @ v)
    h = math.sqrt((1 - np.sum((p + t_m * v) ** 2)) / (v @ v))

    def sigma(x: np.ndarray) -> np.ndarray:
        points = torch.from_numpy(x.reshape(-1, 3))
        return (
            cosine_density(form, geometry, torch.zeros(len(points), dtype=torch.int64), points)
            .numpy()
            .reshape(x.shape[:-1])
        )

    t = np.linspace(t_m - h, t_m + h, 4001)
    along = sigma(origin + t[:, None] * d)
    summed = float(np.sum((along[1:] + along[:-1]) / 2) * (t[1] - t[0]))

    viewmat = look_at(torch.from_numpy(origin), torch.from_numpy(aim), torch.tensor([0.0, 0.0, 1.0]))
    K = torch.tensor([[[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]])  # one pixel whose centre looks along d
    tensors = {**geometry.tensors(), **form.tensors(), "colors": torch.ones(1, 1).double()}
    settings = {"backend": "reference", "alpha_max": 0.9999}
    drawn = neuprim.rasterize(tensors, viewmat[None], K, (1, 1), omega0=OMEGA0, **settings)
    closed = -math.log1p(-float(drawn.alpha))

    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.3), width_ratios=(1.15, 1), layout="constrained")
    grid = np.stack(
        [*np.meshgrid(np.linspace(-1.15, 1.15, 460), np.linspace(-0.85, 0.85, 340)), np.zeros((340, 460))], -1
    )
    inside = np.sum((grid @ R / s) ** 2, -1) < 1
    shown = left.imshow(
        np.where(inside, sigma(grid), np.nan),
        extent=(-1.15, 1.15, -0.85, 0.85),
        origin="lower",
        cmap="RdBu_r",
        vmin=-2.3,
        vmax=2.3,
    )
    ends = origin + np.array([[t_m - h], [t_m + h]]) * d
    left.plot(*np.stack([origin, origin + 4.2 * d])[:, :2].T, color="0.45", lw=1, ls="--")
    left.plot(*ends[:, :2].T, color="black", lw=2)
    left.plot(*(origin + t_m * d)[:2], "o", color="black", ms=5)
    left.annotate("x$_m$", (origin + t_m * d)[:2], (6, -12), textcoords="offset points")
    for label, end, shift in (("t$_0$", ends[0], (-14, 5)), ("t$_1$", ends[1], (2, 9))):
        left.annotate(label, end[:2], shift, textcoords="offset points")
    left.set(
        xlim=(-1.3, 1.3), ylim=(-0.85, 0.85), title="density of one primitive, a ray, their chord", xticks=[], yticks=[]
    )
    left.spines[:].set_visible(False)
    figure.colorbar(shown, ax=left, shrink=0.8, label="σ (1/scene unit)")
    right.plot(t - t_m, along, color="black", lw=1.5)
    right.fill_between(t - t_m, along, where=along >= 0, color="#ff5722", alpha=0.35)
    right.fill_between(t - t_m, along, where=along < 0, color="#2196f3", alpha=0.35)
    right.axhline(0, color="0.6", lw=0.8)
    right.set_xticks([-1, -0.5, 0, 0.5, 1])
    right.set(xlabel="t − t$_m$ along the ray (scene units)", ylabel="σ", title="its integral")
    text = (
        f"closed form  I = {closed:.6f}\n4,000 steps  I = {summed:.6f}\nα = 1 − exp(−I) = {1 - math.exp(-closed):.4f}"
    )
    right.text(0.03, 0.03, text, transform=right.transAxes, va="bottom", family="monospace", fontsize=8)
    right.set_ylim(min(along.min(), 0) - 1.0, along.max() + 0.2)
    if abs(closed - summed) > 1e-5:
        sys.exit(f"the closed form says {closed}, the sum {summed}")
    figure.savefig(target, dpi=130)


FIGURES = {"chord.png": chord, "edges.png": edges}

if __name__ == "__main__":
    if len(sys.argv) != 2 or Path(sys.argv[1]).name not in FIGURES:
        sys.exit(__doc__)
    place = Path(sys.argv[1])
    place.parent.mkdir(parents=True, exist_ok=True)
    FIGURES[place.name](place)
