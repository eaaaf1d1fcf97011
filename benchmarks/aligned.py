"""How much of the error of held-out photographs is their cameras': each is moved to where a finished run's model fits
it best.

    python benchmarks/aligned.py RUN_DIR [--views NAME …] [--steps 60]

A small rotation about the camera and a shift follow the gradient of the image's squared error; focal lengths stay. A
camera's motion is the opposite motion of the whole model, so any backend has its gradient. Colours keep the directions
that they were learned for. A PSNR after aligning is no measure of a model, as it has looked at the photograph; it says
whether cameras or the model are to blame. Masked pixels do not count.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from kornia.geometry.conversions import axis_angle_to_quaternion
from kornia.geometry.quaternion import Quaternion
from shared.tables import Table
from torch import Tensor

from neuprim.core.data import Pixels, View
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.runs.open import load_dataset, load_run


def moved(model: Primitives, eye: Tensor, rotation: Tensor, shift: Tensor) -> Primitives:
    """The model turned by an axis-angle vector (3,) about ``eye`` (3,) and shifted by (3,), in world space."""
    turn = Quaternion(axis_angle_to_quaternion(rotation)[None])
    params = {name: value.detach() for name, value in model.params.items()}
    params["means"] = eye + (params["means"] - eye) @ turn.matrix()[0].T + shift
    params["quats"] = (turn * Quaternion(params["quats"])).data
    return Primitives(model.density, model.colour, params)


def align(
    model: Primitives, view: View, pixels: Pixels, background: Tensor, settings: RenderSettings, steps: int
) -> tuple[float, float, float, float]:
    """PSNR before and after, and how far the camera went: pixels that the rotation alone moves the image's middle by,
    and scene units."""
    truth, eye = pixels.over(background), view.camera.position.float()
    mask = torch.ones(truth.shape[:2], dtype=torch.bool) if pixels.mask is None else pixels.mask
    rotation, shift = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
    distance = float((model.params["means"].detach() - eye).norm(dim=1).median())
    rates = [{"params": [rotation], "lr": 1e-3}, {"params": [shift], "lr": 1e-3 * distance}]
    optimizer = torch.optim.Adam(rates)
    found = []
    for step in range(steps + 1):
        drawn = render(moved(model, eye, rotation, shift), view.camera, view.conditions, settings, background).rgb
        error = (drawn - truth)[mask].square().mean()
        if step in (0, steps):
            found.append(psnr(drawn.detach()[mask][None], truth[mask][None]))
        if step < steps:
            optimizer.zero_grad()
            error.backward()
            optimizer.step()
    return found[0], found[-1], float(rotation.detach().norm() * view.camera.fx), float(shift.detach().norm())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--views", nargs="*", help="names of held-out views; all unless said")
    parser.add_argument("--steps", type=int, default=60)
    args = parser.parse_args()
    config, task, model, _ = load_run(args.run)
    data = load_dataset(config, task)
    torch.set_num_threads(1)
    made = Table("view", "PSNR", "after aligning its camera", "gain", "turned by", "shifted by")
    for place in range(len(data.test)):
        view = data.test.view(place)
        if args.views is None or view.name in args.views:
            settings = replace(config.renderer, backend="cpu")
            before, after, turned, shifted = align(
                model, view, data.test.pixels(place), data.background.float(), settings, args.steps
            )
            made.row(
                view.name,
                f"{before:.2f}",
                f"{after:.2f}",
                f"{after - before:+.2f} dB",
                f"{turned:.2f} pixels",
                f"{shifted:.3f}",
            )


if __name__ == "__main__":
    main()
