"""How well Gaussians become primitives, and primitives Gaussians, for each edge.

    python benchmarks/gaussians.py [RUN_DIR ...] [--parts rule import export] [--edges 0 1 2] [--iterations 600]
    [--docs]

    rule     the support and the depth that a Gaussian gets, and how far its footprint and a primitive's are apart, both
    ways import   a cloud of random Gaussians, drawn as the 3DGS rasteriser draws them and exactly, as densities in
    space, against the primitives
             (K = 0) that a PLY file of it starts a model from; by the former rule, semi-axes of sqrt 5 deviations, too
    export   trained models against their gaussian-ply, by its option `size`; given run directories, or the static
    task's `solids` trained for
             --iterations with K = 8 and K = 0

PSNR in dB over all pixels, on black for the clouds, on the scene's background for the models. --docs puts the tables
between the markers of docs/export.md.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from shared.tables import ROOT, Table, between_markers
from torch import Tensor

from neuprim.config import compose
from neuprim.core.cameras import Camera, look_at
from neuprim.core.metrics import psnr
from neuprim.core.model.colours import sh
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.edge import EDGES, NORMS
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.footprint import gaussian_support
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix
from neuprim.core.model.primitives import Lowered, Primitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.export.appearance import Harmonics
from neuprim.export.gaussians import SIZES, Gaussians, draw_gaussians, fit_gaussians
from neuprim.runs.export import export_run
from neuprim.runs.run import run
from neuprim.tasks.static.fields import SphericalHarmonics

PAGE = ROOT / "docs" / "export.md"
REFERENCE = RenderSettings(backend="reference")
BLACK = torch.zeros(3, dtype=torch.float64)
FAR = 5.0  # standard deviations where the exact Gaussians' support ends
CLOUDS = {"any opacity": (0.05, 0.95), "faint": (0.02, 0.3), "opaque": (0.7, 0.98)}


def cloud(low: float, high: float, count: int = 150) -> dict[str, Tensor]:
    """Overlapping Gaussians in the unit cube, standard deviations 0.04 to 0.16, opacities from ``low`` to ``high``."""
    g = torch.Generator().manual_seed(0)

    def u(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64) * 2 - 1

    values = {"means": u(count, 3) / 2, "deviations": 0.08 * (0.7 * u(count, 3)).exp(), "quats": u(count, 4)}
    return values | {"alphas": low + (high - low) * (u(count) + 1) / 2, "colors": (u(count, 3) + 1) / 2}


def views(size: int = 128) -> list[Camera]:
    f, up = 0.5 * size / math.tan(math.radians(20)), torch.tensor([0.0, 0.0, 1.0])
    eyes = torch.tensor([[0.5, -0.4, 0.77], [1.0, 0.0, 0.2], [-0.3, 1.0, 0.4], [0.1, -0.8, -0.6]], dtype=torch.float64)
    return [Camera(look_at(3 * e / e.norm(), torch.zeros(3), up), f, f, size / 2, size / 2, size, size) for e in eyes]


def splatted(c: dict[str, Tensor], camera: Camera) -> Tensor:
    """As the 3DGS rasteriser draws them."""
    A = quaternion_to_matrix(c["quats"]) * c["deviations"][:, None]
    gaussians = Gaussians(c["means"], A @ A.transpose(1, 2), c["alphas"], torch.arange(len(A)))
    return draw_gaussians(gaussians, Harmonics((c["colors"] - 0.5) / sh.C0, None, 0.0), camera, BLACK)


def thickness(axes: Tensor) -> Tensor:
    return 3 / (axes.amax(1, keepdim=True) / axes).sum(1)


def exactly(c: dict[str, Tensor], camera: Camera) -> Tensor:
    """As Gaussian densities, integrated along every ray in closed form."""
    axes, density = FAR * c["deviations"], GaussianDensity(FAR)
    geometry = Geometry(c["means"], axes.log(), c["quats"])
    central = math.sqrt(2 * math.pi) / FAR * math.erf(FAR / math.sqrt(2))
    amplitude = -torch.log1p(-c["alphas"]) / thickness(axes) / central
    lowered = density.lower({"log_amplitude": amplitude.log()[:, None]}, geometry, {})
    return render_lowered(Lowered(geometry, lowered, Constant(c["colors"])), camera, REFERENCE).rgb.float()


def imported(c: dict[str, Tensor], camera: Camera, edge: int, rule: str) -> Tensor:
    """As primitives: by the "former" rule, by the "ply" file's and by that for Gaussian densities, "volume"."""
    if rule == "former":
        support, depth = torch.full_like(c["alphas"], math.sqrt(5)), -torch.log1p(-c["alphas"])
    else:
        support, depth = gaussian_support(edge, c["alphas"], rule == "volume")
    axes = c["deviations"] * support[:, None]
    b2 = depth / NORMS[edge] / (1.0 if rule == "former" else thickness(axes))
    none = torch.zeros(len(b2), 0, dtype=torch.float64)
    form = Cosine(none[:, :, None].expand(-1, 0, 3), none, none, b2[:, None], edge=edge)
    return render_lowered(
        Lowered(Geometry(c["means"], axes.log(), c["quats"]), form, Constant(c["colors"])), camera, REFERENCE
    ).rgb.float()


RADII = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 * 6


def remains(found: Tensor, wanted: Tensor) -> float:
    """RMS over the screen of the difference of two round footprints, over the RMS of the second."""
    return float((((found - wanted).square() * RADII).sum() / (wanted.square() * RADII).sum()).sqrt())


def footprint(depth: float, support: float, edge: int) -> Tensor:
    return -torch.expm1(-depth * (1 - (RADII / support).square()).clamp_min(0) ** (edge + 0.5))


def rule_table(edges: Sequence[int]) -> str:
    opacities = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    names = ", ".join(f"{o:g}" for o in opacities)
    table = Table(
        "edge",
        f"c for o = {names}",
        "τ/−log(1 − o)",
        "RMS of the difference to the bell, of its own",
        "a ball of depth 0.1 and 3: its bell's, by `profile`",
    )
    for edge in edges:
        support, depth = gaussian_support(edge, opacities)
        bells = [o * (-RADII.square() / 2).exp() for o in opacities]
        apart = [
            remains(footprint(float(t), float(c), edge), bell) for t, c, bell in zip(depth, support, bells, strict=True)
        ]
        shares = depth / -torch.log1p(-opacities)
        cells = [", ".join(f"{x:.2f}" for x in values) for values in (support, shares)]
        percent = [
            ", ".join(f"{100 * x:.0f} %" for x in values) for values in (apart, [ball(edge, 0.1), ball(edge, 3.0)])
        ]
        table.row(edge, *cells, *percent)
    return str(table)


def ball(edge: int, depth: float) -> float:
    """How far the footprint of a ball of this depth and its Gaussian's are apart."""
    density = CosineDensity(0, edge=edge)
    params = {
        "means": torch.zeros(1, 3),
        "log_scales": torch.zeros(1, 3),
        "quats": torch.eye(4)[:1],
        "sh_dc": torch.zeros(1, 3),
    }
    params |= {
        "W1": torch.zeros(1, 0, 3),
        "b1": torch.zeros(1, 0),
        "w2": torch.zeros(1, 0),
        "b2": torch.full((1, 1), depth / NORMS[edge]),
    }
    run: Any = SimpleNamespace(model=Primitives(density, SphericalHarmonics(0), params))
    found = fit_gaussians(run, {}, "profile")
    bell = float(found.opacities[0]) * (-RADII.square() / 2 / float(found.covariances[0, 0, 0])).exp()
    return remains(bell, footprint(depth, 1.0, edge))


def import_table(edges: Sequence[int]) -> str:
    table = Table("150 Gaussians", "drawn", "rule", *(f"edge {edge}" for edge in edges))
    for name, bounds in CLOUDS.items():
        c, cameras = cloud(*bounds), views()
        for drawn, draw, rules in (
            ("3DGS rasteriser", splatted, ("former", "ply")),
            ("exactly, as densities", exactly, ("former", "volume")),
        ):
            truth = [draw(c, camera) for camera in cameras]
            for rule in rules:
                scores = [
                    np.mean(
                        [
                            psnr(imported(c, camera, edge, rule), image)
                            for camera, image in zip(cameras, truth, strict=True)
                        ]
                    )
                    for edge in edges
                ]
                words = {"former": "√5 deviations", "ply": "least squares", "volume": "least squares, of densities"}[
                    rule
                ]
                table.row(
                    f"{name}, {bounds[0]:g} to {bounds[1]:g}", drawn, words, *(f"{score:.1f} dB" for score in scores)
                )
    return str(table)


def trained(folder: Path, neurons: int, edge: int, iterations: int) -> Path:
    words = [
        "task=static",
        "scene=solids",
        "scene.size=128",
        "model.primitives=500",
        f"model.neurons={neurons}",
        f"model.density.edge={edge}",
        f"model.density.gain={'true' if edge else 'false'}",
        f"train.iterations={iterations}",
        "train.max_seconds=null",
        "train.eval_every=0",
        f"train.population.every={max(iterations // 15, 1)}",
        "train.rates.b2=0.03",
        "train.rates.w2=0.03",
        "train.rates.log_scales=0.04",
        f"output_dir='{folder}'",
    ]
    return run(compose(words))


def export_table(runs: Sequence[tuple[str, Path]]) -> str:
    table = Table("model", *(f"size={size}" for size in SIZES))
    for name, folder in runs:
        scores = []
        with tempfile.TemporaryDirectory() as target:
            for size in SIZES:
                report = export_run(folder, "gaussian-ply", Path(target) / f"{size}.ply", [f"size={size}"])
                scores.append(report.errors["psnr"])
        table.row(name, *(f"{score:.1f} dB" for score in scores))
    return str(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--parts", nargs="*", default=["rule", "import", "export"])
    parser.add_argument("--edges", nargs="*", type=int, choices=EDGES, default=EDGES)
    parser.add_argument("--neurons", nargs="*", type=int, default=[8, 0])
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--docs", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    tables = {}
    if "rule" in args.parts:
        tables["gaussians-rule"] = rule_table(args.edges)
    if "import" in args.parts:
        tables["gaussians-import"] = import_table(args.edges)
    if "export" in args.parts:
        with tempfile.TemporaryDirectory() as folder:
            runs = [(str(path), path) for path in args.runs] or [
                (f"`solids`, K = {K}, edge {edge}", trained(Path(folder) / f"{K}_{edge}", K, edge, args.iterations))
                for K in args.neurons
                for edge in args.edges
            ]
            tables["gaussians-export"] = export_table(runs)
    if args.docs:
        for name, text in tables.items():
            between_markers(PAGE, name, text)


if __name__ == "__main__":
    main()
