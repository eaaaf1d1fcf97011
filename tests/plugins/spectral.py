"""A third-party task made on the spot: images of five bands of light, which are no red, green and blue, and a display for them."""

from __future__ import annotations

from pathlib import Path

from neuprim.config import compose
from neuprim.runs.events import Events, silent
from neuprim.runs.run import run
from tests.plugins.fakes import install

NAMES = ("450nm", "550 nm", "650nm", "NIR", "SWIR.1")

TASK = """
import torch

from neuprim.core.choices import choose
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.tasks.static.fields import SphericalHarmonics
from spectraltask.scene import Ball

RED_GREEN_BLUE = torch.tensor([[0.0, 0.1, 0.9], [0.1, 0.7, 0.1], [0.6, 0.2, 0.0], [0.2, 0.0, 0.0], [0.1, 0.0, 0.0]])


def display(image):
    return (image.clamp_min(0) @ RED_GREEN_BLUE.to(image)).clamp(0, 1) ** (1 / 2.4)


def check(model):
    for group in ("density", "colour"):
        choose(model[group], f"model.{group}", {})


def build(model, dataset):
    return CosineDensity(model["neurons"]), SphericalHarmonics(model["sh_degree"], dataset.channels)


TASK = TaskSpec(
    api=1,
    name="spectral",
    summary="bands of light",
    config_package="spectraltask.conf",
    scenes=(SceneSpec("ball", "a ball of many bands", lambda settings, context: Ball(**settings)),),
    build=build,
    loss=photometric,
    check=check,
    fields={"CosineDensity": CosineDensity, "SphericalHarmonics": SphericalHarmonics},
    channels=("450nm", "550 nm", "650nm", "NIR", "SWIR.1"),
    display=display,
)
"""

SCENE = """
import torch

from neuprim.core.cameras import Camera, orbit
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent


class Views(ViewSet):
    def __init__(self, cameras, channels):
        self.cameras, self.channels = cameras, channels

    def __len__(self):
        return len(self.cameras)

    def view(self, index):
        return View(f"view{index}", self.cameras[index])

    def pixels(self, index):
        return draw(self.cameras[index], self.channels)


class Ball(Dataset):
    def __init__(self, size, channels, space):
        self.name, self.channels, self.color_space, self.data_source = "spectral ball", channels, space, "generated"
        self.up, self.center = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
        template = Camera(torch.eye(4), 1.6 * size, 1.6 * size, size / 2, size / 2, size, size)
        cameras = (orbit(template, self.center, self.up, 4.0, e, count) for e, count in ((0.4, 8), (0.6, 2)))
        self.train, self.test = (Views(c, channels) for c in cameras)
        self.extent = camera_extent(self.train.cameras)
        self.background, self.random_background, self.downsampling = torch.full((channels,), 0.05), False, "none"

    def initial_points(self, count, generator):
        points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
        return PointCloud(0.7 * points, torch.full((count, self.channels), 0.5))


def draw(camera, channels):
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], -1).double()
    d = torch.nn.functional.normalize(rays @ camera.viewmat[:3, :3], dim=-1)
    along = d @ camera.position
    inside = along.square() - camera.position.square().sum() + 1
    normal = camera.position + (-along - inside.clamp_min(0).sqrt())[..., None] * d
    alpha = (inside > 0).double()
    middles = torch.linspace(-0.8, 0.8, channels).double()
    bands = 0.1 + 0.8 * torch.exp(-4 * (normal[..., 2:] - middles) ** 2)
    return Pixels((bands * alpha[..., None]).float(), alpha.float())
"""

FILES = {
    "spectraltask/__init__.py": TASK,
    "spectraltask/scene.py": SCENE,
    "spectraltask/conf/__init__.py": "",
    "spectraltask/conf/task/spectral.yaml": "scene: ball\n",
    "spectraltask/conf/scene/spectral/ball.yaml": "size: 24\nchannels: 5\nspace: linear\n",
    "spectraltask/conf/preset/spectral/quick.yaml": (
        "model: {primitives: 60, neurons: 2, sh_degree: 0}\ntrain: {iterations: 60, max_seconds: null, rates: {means: 1.6e-3}}\n"
    ),
}


def install_spectral(site: Path, **changes: str) -> None:
    """The package in a folder on ``sys.path``; ``changes`` replace lines of the TaskSpec, e.g. ``display="None"``."""
    text = TASK
    for name, value in changes.items():
        line = next(line for line in text.splitlines() if line.startswith(f"    {name}="))
        text = text.replace(line, f"    {name}={value},")
    install(site, "neuprim-spectral", {"spectral": "spectraltask:TASK"}, {**FILES, "spectraltask/__init__.py": text})


def fit(out: Path, *words: str, events: Events = silent) -> Path:
    """A short run of the task."""
    return run(compose(["task=spectral", f"output_dir='{out}'", *words]), events)
