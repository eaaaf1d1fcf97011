"""How fast a model's extinction is put on a grid, against plain torch in float64 on some of the same points.

    python benchmarks/density_grid.py [RUN_DIR] [--grid 256] [--primitives 5000] [--points 2000] [--threads 0] [--time
    0.5]

Without a run, a made-up model of primitives that overlap about twenty-fold. Prints both times, their ratio per point,
and the largest difference in units of the largest extinction.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
import torch

from neuprim.core.compute.threads import core_count
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.volumes.grid import density_at, density_grid, lattice
from neuprim.tasks.static.fields import SphericalHarmonics


def made_up(count: int) -> Primitives:
    """Primitives in the unit cube, of radii that make about twenty of them overlap anywhere."""
    generator = torch.Generator().manual_seed(0)
    radius = (20.0 / count * 3.0 / (4.0 * torch.pi)) ** (1.0 / 3.0)
    means = torch.rand((count, 3), generator=generator) - 0.5
    context = InitContext(means, torch.full((count,), radius), torch.full((count, 3), 0.5), generator)
    model = Primitives.initialise(CosineDensity(8), SphericalHarmonics(0), context)
    model.params["log_scales"] += 0.3 * torch.randn((count, 3), generator=generator)
    model.params["quats"] += 0.5 * torch.randn((count, 4), generator=generator)
    model.params["w2"] *= 5.0
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path, nargs="?")
    parser.add_argument("--grid", type=int, default=256)
    parser.add_argument("--primitives", type=int, default=5000)
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--time", type=float, default=0.5)
    args = parser.parse_args()
    conditions = {"time": torch.tensor(args.time)}
    if args.run_dir:
        from neuprim.runs.open import load_run

        model = load_run(args.run_dir)[2]
    else:
        model = made_up(args.primitives)
    geometry, _ = model.lower_density(conditions)
    low, high = geometry.means.detach().double().quantile(torch.tensor([0.01, 0.99]).double(), dim=0)
    matrix, shape = lattice(torch.stack([low, high]), args.grid)
    density_grid(model, conditions, matrix, (8, 8, 8))  # compiles
    start = time.perf_counter()
    grid = density_grid(model, conditions, matrix, shape, args.threads)
    seconds = time.perf_counter() - start
    index = np.random.default_rng(0).integers(0, shape, (args.points, 3))
    points = torch.from_numpy(index).double() @ matrix[:3, :3].T + matrix[:3, 3]
    torch.set_num_threads(args.threads or core_count())
    start = time.perf_counter()
    truth = density_at(model, conditions, points)
    plain = time.perf_counter() - start
    error = float((grid[tuple(index.T)].double() - truth).abs().max() / truth.max())
    ratio = (plain / args.points) / (seconds / grid.numel())
    cell = float(torch.linalg.det(matrix[:3, :3]))
    overlap = float((geometry.scales.double().prod(1) * 4.1888).sum() / cell) / grid.numel()
    print(
        f"{geometry.count} primitives on {' x '.join(map(str, shape))} points, about {overlap:.0f} per point, {args.threads or core_count()} threads"
    )
    print(f"grid   {seconds:8.2f} s   {1e9 * seconds / grid.numel():10.1f} ns per point")
    print(
        f"torch  {plain:8.2f} s   {1e9 * plain / args.points:10.1f} ns per point, float64, {args.points} of the points"
    )
    print(f"ratio  {ratio:8.0f}     largest difference {error:.1e} of the largest extinction")
    print(f"peak memory of the process {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
