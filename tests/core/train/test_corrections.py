"""Corrections of cameras and lights that a data set knows only roughly, learned with the model."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, View, ViewSet
from neuprim.core.errors import CheckpointError
from neuprim.core.render import RenderSettings, render
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.core.train.training_views import ViewCorrections
from neuprim.plugins.losses import photometric
from neuprim.tasks.relight.colour import LightNetwork
from tests import lit_models, scenes
from tests.core import tiny

UP = torch.tensor([0.0, 0.0, 1.0])


class ListedViews(ViewSet):
    """Views with images of other ones."""

    def __init__(self, views: list[View], images: list[Pixels]) -> None:
        self.views, self.images = views, images

    def __len__(self) -> int:
        return len(self.views)

    def view(self, index: int) -> View:
        return self.views[index]

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def with_moved_cameras(dataset: Dataset) -> Dataset:
    """Cameras rotated and shifted on their own axes, but not all alike."""
    given = [dataset.train.view(i) for i in range(len(dataset.train))]
    poses = torch.stack([view.camera.viewmat for view in given])
    corrections = ViewCorrections(poses, {"camera": "pose"}, dataset.extent, torch.device("cpu"))
    corrections.numbers = 0.02 * torch.randn(len(given), 6, generator=torch.Generator().manual_seed(3))
    corrections.step_at(1.0, {})
    with torch.no_grad():
        views = [corrections.apply(i, view) for i, view in enumerate(given)]
    images = [dataset.train.pixels(i) for i in range(len(given))]
    return replace(dataset, train=ListedViews(views, images), refine={"camera": "pose"})


def fixed(trainer: Trainer) -> dict[str, float]:
    return dict.fromkeys((spec.name for spec in trainer.model.specs), 0.0)


def corrected(trainer: Trainer, index: int) -> View:
    assert trainer.corrections is not None
    return trainer.corrections.apply(index, trainer.dataset.train.view(index))


def test_cameras_are_found() -> None:
    """Of a model that was trained with the right ones and stays as it is."""
    exact = tiny.two_primitives()
    first = tiny.trainer(exact, 400)
    list(first.run())
    rough = with_moved_cameras(exact)
    second = tiny.trainer(rough, 900, rates=fixed(first), final_rate=0.05)
    second.model.params = {name: value.detach().clone().requires_grad_() for name, value in first.model.params.items()}
    list(second.run())
    points = 0.3 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))

    def error(cameras: list[Camera]) -> float:
        """Of the pixels of points in the scene: turning and shifting a camera show nearly the same."""
        pairs = zip(cameras, map(exact.train.view, range(len(cameras))), strict=True)
        return math.hypot(*((a.project(points)[0] - b.camera.project(points)[0]).norm() for a, b in pairs))

    count = len(exact.train)
    before = error([rough.train.view(i).camera for i in range(count)])
    with torch.no_grad():
        after = error([corrected(second, i).camera for i in range(count)])
    assert after < 0.4 * before, (before, after)
    assert second.corrections is not None and "camera" in second.corrections.summary()


def test_moving_all_cameras_alike_is_undone() -> None:
    """No image shows a rotation, a shift or a scale of the whole scene; what else the cameras do stays."""
    g, small = torch.Generator().manual_seed(5), 1e-5
    eyes = 3 + torch.randn(5, 3, generator=g, dtype=torch.float64)
    cameras = [replace(scenes.camera(), viewmat=look_at(eye, torch.zeros(3), UP)) for eye in eyes]
    given = [View(str(i), camera, {"light": torch.zeros(3)}) for i, camera in enumerate(cameras)]
    poses = torch.stack([view.camera.viewmat for view in given])
    corrections = ViewCorrections(poses, {"light": "offset", "camera": "pose"}, 2.0, torch.device("cpu"))

    def motions() -> Tensor:
        """(V, 6): how each camera is rotated and shifted, on its own axes."""
        with torch.no_grad():
            now = [corrections.apply(i, view).camera.viewmat for i, view in enumerate(given)]
        change = torch.stack(now) @ poses.inverse()
        rotations = change[:, [2, 0, 1], [1, 2, 0]]
        return torch.cat([rotations, change[:, :3, 3]], 1)

    w, d, scale = small * torch.randn(3, generator=g), small * torch.randn(3, generator=g), small
    turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3), w.expand(3, 3)).T.double())
    for alike in (True, False):
        for i, view in enumerate(given):
            center = turn @ view.camera.position * (1 + scale) + d
            rotation = view.camera.viewmat[:3, :3] @ turn.T
            moved = torch.cat([rotation, -(rotation @ center)[:, None]], 1)
            wanted = moved @ poses[i].inverse()
            corrections.numbers[i] = 0.0
            corrections.numbers[i, 3:6] = wanted[[2, 0, 1], [1, 2, 0]].float()
            corrections.numbers[i, 6:] = ((wanted[:, 3] - motions()[i, 3:]) / 2.0).float()
        before = motions().norm()
        if not alike:
            corrections.numbers[2, 7] += small
        corrections.step_at(1.0, {})
        assert (motions().norm() < 1e-3 * before) == alike, alike


@pytest.mark.parametrize(("converging", "furthest"), [(0.0, 1.0), (1e-3, 1.0), (0.5, 3.0)])
def test_rotations_do_not_move_cameras_far(converging: float, furthest: float) -> None:
    """Cameras in a row, up to 2 units apart, whose axes are parallel, almost parallel, or meet 2 units before them."""
    places = [torch.tensor([x, 0.1 * x * x, 0.0], dtype=torch.float64) for x in (-1.0, -0.5, 0.5, 1.0)]
    target = [place + torch.tensor([-converging * float(place[0]), 1.0, 0.0]) for place in places]
    cameras = [replace(scenes.camera(), viewmat=look_at(*both, UP)) for both in zip(places, target, strict=True)]
    poses = torch.stack([camera.viewmat for camera in cameras])
    corrections = ViewCorrections(poses, {"camera": "pose"}, 1.0, torch.device("cpu"))
    corrections.numbers[:, :3] = 0.1
    with torch.no_grad():
        moved = [corrections.apply(i, View("v", camera)).camera.position for i, camera in enumerate(cameras)]
    assert max(float((a - b).norm()) for a, b in zip(moved, places, strict=True)) < 0.18 * furthest


def test_lights_are_found() -> None:
    """Positions and intensities, of a model that is known."""
    model = lit_models.model(LightNetwork(3, visibility="none"), torch.float32)
    g, cameras = torch.Generator().manual_seed(1), [scenes.camera(width=24, height=24)] * 4
    lights = [3 * torch.nn.functional.normalize(torch.randn(3, generator=g), dim=0) for _ in cameras]

    def views(positions: list[Tensor], strengths: list[float]) -> list[View]:
        conditions = [lit_models.light(*p.tolist(), s) for p, s in zip(positions, strengths, strict=True)]
        return [View(str(i), *both) for i, both in enumerate(zip(cameras, conditions, strict=True))]

    true = views(lights, [1.0] * 4)
    with torch.no_grad():
        images = [Pixels(render(model, v.camera, v.conditions, RenderSettings()).rgb) for v in true]
    rough = views([p + 0.3 * torch.randn(3, generator=g) for p in lights], [1.1, 0.9, 1.2, 0.8])
    dataset = replace(
        tiny.two_primitives(),
        train=ListedViews(rough, images),
        background=torch.zeros(3),
        extent=3.0,
        refine={"light": "offset", "light_intensity": "factor"},
    )
    settings = TrainSettings(iterations=1600, final_rate=0.05, rates={spec.name: 0.0 for spec in model.specs})
    settings.population.strategy = "fixed"
    trainer = Trainer(model, dataset, photometric({"ssim_weight": 0.0}), settings, RenderSettings(), 0)
    list(trainer.run())
    with torch.no_grad():
        found = [corrected(trainer, i).conditions for i in range(4)]
    for name, part in (("light", 0.3), ("light_intensity", 0.3)):
        before, after = (
            math.hypot(*((a[name] - b.conditions[name]).norm() for a, b in zip(conditions, true, strict=True)))
            for conditions in ([v.conditions for v in rough], found)
        )
        assert after < part * before, (name, before, after)


def test_they_are_saved_and_go_on() -> None:
    rough = with_moved_cameras(tiny.two_primitives())
    whole, first, second = (tiny.trainer(rough, 30) for _ in range(3))
    losses = [report.loss for report in whole.run()]
    begun = [first.train_step().loss for _ in range(13)]
    state = first.state()
    second.load_state(*state, "c")
    assert begun + [report.loss for report in second.run()] == losses
    assert whole.corrections is not None and float(whole.corrections.numbers.abs().max()) > 0
    with pytest.raises(CheckpointError, match=r"it has correction\.\w+, which these settings do not use"):
        tiny.trainer(replace(rough, refine={}), 30).load_state(*state, "c")
