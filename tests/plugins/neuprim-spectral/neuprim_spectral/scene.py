"""A ball of three belts that reflect different wavelengths, ray-cast on the spot, with the bands shifted from view to
view."""

import torch

from neuprim.core.cameras import Camera, orbit
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.errors import ConfigError

# Where in the range of the bands, 0 to 1, each belt reflects most.
_PEAKS = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)


class BallViews(ViewSet):
    def __init__(self, cameras, bands):
        self.cameras, self.bands = cameras, bands

    def __len__(self):
        return len(self.cameras)

    def view(self, index):
        return View(f"view{index}", self.cameras[index], {"wavelength_shift": torch.tensor((index * 0.37) % 1.0)})

    def pixels(self, index):
        return _draw(self.cameras[index], self.bands, self.view(index).conditions["wavelength_shift"])


def ball(size, train_views, test_views, bands=5, space="linear"):
    for name, value in (("size", size), ("train_views", train_views), ("test_views", test_views), ("bands", bands)):
        if not isinstance(value, int) or value < 1:
            raise ConfigError(f"scene.{name}={value}: expected a whole number of at least 1")
    if space not in ("linear", "srgb"):
        raise ConfigError(f"scene.space={space}: expected linear or srgb")
    template = Camera(torch.eye(4), 1.6 * size, 1.6 * size, size / 2, size / 2, size, size)
    rings = ((0.4, train_views), (0.5, test_views))  # elevation in radians
    middle, up = torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])
    train, test = (BallViews(orbit(template, middle, up, 4.0, e, count), bands) for e, count in rings)

    def start(views, count, generator):
        points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
        return PointCloud(0.8 * points, torch.full((count, bands), 0.3))

    return Dataset(
        name="ball",
        train=train,
        test=test,
        start=start,
        extent=camera_extent(train.cameras),
        background=torch.full((bands,), 0.05),
        channels=bands,
        color_space=space,
        data_source="generated",
    )


def _draw(camera, bands, shift):
    """Rays through pixel centres meet |x| = 1; colours are premultiplied by coverage."""
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], -1).double()
    d = torch.nn.functional.normalize(rays @ camera.viewmat[:3, :3], dim=-1)
    along = d @ camera.position
    inside = along.square() - camera.position.square().sum() + 1
    height = (camera.position + (-along - inside.clamp_min(0).sqrt())[..., None] * d)[..., 2].contiguous()
    belt = torch.bucketize(height, torch.tensor([-0.3, 0.3], dtype=torch.float64))
    wavelengths = (torch.arange(bands) + shift.double()) / max(bands - 1, 1)
    colours = 0.1 + 0.8 * torch.exp(-12 * (wavelengths - _PEAKS[belt][..., None]).square())
    alpha = (inside > 0).double()
    return Pixels((colours * alpha[..., None]).float(), alpha.float())
