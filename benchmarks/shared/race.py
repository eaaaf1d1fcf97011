"""gsplat's 3D Gaussians on the data set that a run of neuprim trains on, by its documented interface alone.

A population of fixed size starts where neuprim's does and is kept alive by gsplat's own MCMCStrategy; losses, rates and
degrees are those that gsplat's example of it uses, and the budget is neuprim's: as many steps, one view each. Nothing
of gsplat is imported before it is asked for.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.data import Dataset, ViewSet
from neuprim.core.metrics import psnr
from neuprim.core.train.ssim_torch import photometric_torch

__all__ = ["DEGREE", "FLOATS", "Lap", "equal_psnr", "gaussians", "lap", "opened"]

DEGREE = 3
FLOATS = 3 + 3 + 4 + 1 + 3 * (DEGREE + 1) ** 2
"""Numbers of a Gaussian."""

_SH0 = 0.28209479177387814
_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
"""Of Adam, a step; that of the centres is per extent of the cameras, and falls to a hundredth."""

_OPACITY, _SCALE = 0.01, 0.01
"""What opacities and scales cost, so that the strategy has dead ones to move."""

_NEIGHBOURS = 3


def opened() -> Any:
    """The package, or None where it is not installed."""
    try:
        import gsplat
    except ImportError:
        return None
    return gsplat


@dataclass(frozen=True)
class Lap:
    """One training.

    Attributes:
        count: Gaussians. bytes: of their numbers as float32.
        psnr: mean over the test views, dB.
        step_ms: a step of the second half. frame_ms: a test view without gradients, the median.
    """

    count: int
    bytes: int
    psnr: float
    step_ms: float
    frame_ms: float


def gaussians(dataset: Dataset, count: int, device: torch.device, seed: int = 0) -> dict[str, torch.nn.Parameter]:
    """What gsplat's strategies call them: logarithms of scales and log odds of opacities; as wide as the mean distance
    to three neighbours."""
    cloud = dataset.initial_points(count, torch.Generator().manual_seed(seed))
    near = min(_NEIGHBOURS + 1, count)
    distances = torch.from_numpy(cKDTree(cloud.means.numpy()).query(cloud.means.numpy(), k=near)[0]).reshape(
        count, near
    )[:, 1:]
    width = distances.square().mean(1).sqrt().clamp_min(1e-6).log()
    generator = torch.Generator().manual_seed(seed)
    values = {
        "means": cloud.means,
        "scales": width[:, None].expand(count, 3),
        "quats": torch.rand(count, 4, generator=generator),
        "opacities": torch.full((count,), math.log(0.5 / 0.5)),
        "sh0": ((cloud.colors - 0.5) / _SH0)[:, None, :],
        "shN": torch.zeros(count, (DEGREE + 1) ** 2 - 1, 3),
    }
    return {name: torch.nn.Parameter(value.float().contiguous().to(device)) for name, value in values.items()}


def _drawn(
    gsplat: Any, params: dict[str, torch.nn.Parameter], camera: Camera, background: Tensor, degree: int
) -> tuple[Tensor, Any]:
    """(H, W, 3) colours and what the strategy wants to know."""
    device = params["means"].device
    K = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device)
    colors, _, info = gsplat.rasterization(
        means=params["means"],
        quats=params["quats"],
        scales=params["scales"].exp(),
        opacities=params["opacities"].sigmoid(),
        colors=torch.cat([params["sh0"], params["shN"]], 1),
        viewmats=camera.viewmat.float().to(device)[None],
        Ks=K[None],
        width=camera.width,
        height=camera.height,
        sh_degree=degree,
        packed=False,
        backgrounds=background[None],
    )
    return colors[0], info


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def lap(gsplat: Any, dataset: Dataset, count: int, steps: int, device: torch.device, seed: int = 0) -> Lap:
    """Train ``count`` Gaussians, then draw the test views."""
    params = gaussians(dataset, count, device, seed)
    rates = {**_RATES, "means": _RATES["means"] * dataset.extent}
    adams = {name: torch.optim.Adam([value], lr=rates[name], eps=1e-15) for name, value in params.items()}
    strategy = gsplat.MCMCStrategy(
        cap_max=count, refine_start_iter=min(500, steps // 5), refine_stop_iter=steps - steps // 10
    )
    strategy.check_sanity(params, adams)
    state = strategy.initialize_state()
    background = dataset.background.float().to(device)
    views = [dataset.train.view(i).camera for i in range(len(dataset.train))]
    truths = [dataset.train.pixels(i).to(device).over(background) for i in range(len(views))]
    generator, order = torch.Generator().manual_seed(seed), torch.empty(0, dtype=torch.int64)
    begun = 0.0
    for step in range(steps):
        if step == steps // 2:
            _wait(device)
            begun = time.perf_counter()
        if not len(order):
            order = torch.randperm(len(views), generator=generator)
        index, order = int(order[0]), order[1:]
        rate = rates["means"] * 0.01 ** (step / steps)
        adams["means"].param_groups[0]["lr"] = rate
        image, info = _drawn(gsplat, params, views[index], background, min(DEGREE, step * 2 * DEGREE // steps))
        loss, _ = photometric_torch(image, truths[index], 0.2)
        loss = loss + _OPACITY * params["opacities"].sigmoid().mean() + _SCALE * params["scales"].exp().mean()
        loss.backward()
        for adam in adams.values():
            adam.step()
            adam.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, adams, state, step, info, rate)
    _wait(device)
    step_ms = 1e3 * (time.perf_counter() - begun) / max(steps - steps // 2, 1)
    score, frame_ms = judged(gsplat, params, dataset.test, background)
    return Lap(len(params["means"]), 4 * FLOATS * len(params["means"]), score, step_ms, frame_ms)


def judged(
    gsplat: Any, params: dict[str, torch.nn.Parameter], views: ViewSet, background: Tensor
) -> tuple[float, float]:
    """Mean PSNR in dB, and the median milliseconds of a frame."""
    scores, times = [], []
    with torch.no_grad():
        for i in range(len(views)):
            camera = views.view(i).camera
            _drawn(gsplat, params, camera, background, DEGREE)
            _wait(background.device)
            begun = time.perf_counter()
            image, _ = _drawn(gsplat, params, camera, background, DEGREE)
            _wait(background.device)
            times.append(1e3 * (time.perf_counter() - begun))
            scores.append(psnr(image.clamp(0, 1).cpu(), views.pixels(i).over(background.cpu())))
    return statistics.mean(scores), statistics.median(times)


def equal_psnr(run: Callable[[int], Lap], counts: Sequence[int], wanted: float) -> tuple[list[Lap], Lap | None]:
    """Laps of rising counts up to the first that has ``wanted`` dB, and that one; None where none has."""
    laps = []
    for count in counts:
        laps.append(run(count))
        if laps[-1].psnr >= wanted:
            return laps, laps[-1]
    return laps, None
