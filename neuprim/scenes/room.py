"""Generator of the scene ``room``: simulated photographs from a walk around the solids, with lens distortion.

transforms.json, images/...    layout of nerfstudio, with OpenCV's lens distortion and a train/test split
points.ply                     simulated structure from motion: points where images have detail; a few points are wrong
exposures.json                 image -> exposure factor that multiplies the linear values of the image
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data.image_views import RadialDistortion
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import write_json
from neuprim.core.io.ply import write_ply
from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.image_set import (
    RAYS_AT_ONCE,
    ImageSize,
    Progress,
    Supersampling,
    average_scene_rays,
    draw_in_parallel,
    hash_scene_settings,
    scene_drawing_text,
    write_scene_folder,
)
from neuprim.scenes.raycast import Engine, Hits, Scene
from neuprim.scenes.room_interior import ABOVE, BELOW, BULB, LAMP, LAMP_POWER, Furnishing, Texture, furnish_room
from neuprim.scenes.shading import (
    add_scene_surroundings,
    encode_scene_srgb,
    reflect_light,
    scene_light_visibility,
    shading_dot,
)
from neuprim.scenes.shapes import Solid, build_solids, uniform_colour

GENERATOR_VERSION = 1
"""Part of the cache's key: raise it with every change to the room, its light, cameras or file layout."""

LENS = RadialDistortion(k1=-0.08, k2=0.02, p1=0.001, p2=-0.0005)

NOISE = 0.005  # root of the mean squared displacement of a point, over its distance to the camera that found it
OUTLIERS = 0.02  # share of points that lie anywhere between their camera and the surface
_PLAIN = 0.03  # chance of a pixel without detail to become a point, over that of one with the mean detail
_ROUNDS = 40  # of drawing points
_WALKS_SEEDS = {"train": 20250311, "test": 20250312}
_POINTS_SEED, _EXPOSURE_SEED = 20250313, 20250314
_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)

_Shot = tuple[str, NDArray[np.float64], float]  # name of the image's file, pose, gain


@dataclass(frozen=True)
class RoomSettings:
    """Settings of ``scene=room``."""

    size: ImageSize = 200  # width of the images in pixels; the height is three quarters of it
    train_views: Annotated[int, Range(2, 10000)] = 80
    test_views: Annotated[int, Range(1, 10000)] = 20
    supersampling: Supersampling = 2  # rays per pixel along each axis
    exposure: Annotated[float, Range(0, 2)] = 0.15  # largest change of a training image's exposure, in stops
    points: Annotated[int, Range(1, 1000000)] = 3000  # number of points of the simulated reconstruction
    distortion: bool = True  # whether the lens distorts the images

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        return hash_scene_settings(self, GENERATOR_VERSION)


def generate_room(settings: RoomSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the files of ``scene=room`` unless they exist; return the folder ``cache_dir/room-KEY``."""
    poses = room_camera_poses(settings.train_views, settings.test_views)
    gains = room_exposure_gains(settings.train_views, settings.exposure).tolist()
    shots = [(f"train_{i:04d}.png", pose, gains[i]) for i, pose in enumerate(poses["train"])]
    shots += [(f"test_{i:04d}.png", pose, 1.0) for i, pose in enumerate(poses["test"])]
    files = ["transforms.json", "points.ply", "exposures.json", *(f"images/{name}" for name, _, _ in shots)]
    folder = Path(cache_dir) / f"room-{settings.key()}"
    what = "scene room: cannot write the generated images"
    return write_scene_folder(folder, files, lambda folder: _write_room(folder, settings, shots, progress), what)


def build_room(settings: RoomSettings) -> Room:
    """Build the scene ``room``; its textures are filtered for the distance between neighbouring rays of the images."""
    return Room(build_solids(), furnish_room(), 1 / (room_lens(settings).focal * settings.supersampling))


def room_exposure_gains(count: int, stops: float) -> NDArray[np.float64]:
    """Return (count,) random exposure factors of training images; their log2 is uniform in -``stops``..``stops``."""
    return 2.0 ** (stops * (2 * np.random.default_rng(_EXPOSURE_SEED).random(count) - 1))


def _write_room(folder: Path, settings: RoomSettings, shots: list[_Shot], progress: Progress) -> None:
    progress("room: building the scene", 0.0)
    room, lens = build_room(settings), room_lens(settings)
    images = folder / "images"
    images.mkdir()

    def draw(shot: _Shot) -> None:
        name, pose, gain = shot
        Image.fromarray(photograph_room(room, lens, pose, settings.supersampling, gain)).save(images / name)

    text = scene_drawing_text("room", room, lens.width, lens.height)
    draw_in_parallel(draw, shots, lambda fraction: progress(text, fraction))

    def luma(index: int) -> NDArray[np.float32]:
        with Image.open(images / shots[index][0]) as image:
            bright: NDArray[np.float32] = np.asarray(image, dtype=np.float32) @ _LUMA
        return bright / np.float32(255)

    poses = [pose for _, pose, _ in shots[: settings.train_views]]
    points = reconstruct_room_points(room, lens, poses, luma, settings.points)
    rows = np.empty(
        len(points.position), [*((n, "<f4") for n in "xyz"), *((n, "u1") for n in ("red", "green", "blue"))]
    )
    for i, (axis, channel) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[axis], rows[channel] = points.position[:, i], points.rgb[:, i]
    write_ply(folder / "points.ply", rows)
    write_json(folder / "exposures.json", {f"images/{name}": gain for name, _, gain in shots})
    write_json(folder / "transforms.json", _room_transforms_document(lens, shots))


def _room_transforms_document(lens: RoomLens, shots: list[_Shot]) -> dict[str, Any]:
    camera, names = lens.camera, [f"images/{name}" for name, _, _ in shots]
    return {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **{key: value for key, value in asdict(lens.distortion).items() if value},
        "ply_file_path": "points.ply",
        "train_filenames": [name for name in names if "/train_" in name],
        "test_filenames": [name for name in names if "/test_" in name],
        "frames": [{"file_path": f"images/{name}", "transform_matrix": pose.tolist()} for name, pose, _ in shots],
    }


# ---------------------------------------------------------------- the lens


@dataclass(frozen=True)
class RoomLens:
    """Camera intrinsics for images ``width`` pixels wide. If ``distortion`` is all zero, the camera is a pinhole."""

    width: int
    distortion: RadialDistortion = LENS

    @property
    def height(self) -> int:
        return round(0.75 * self.width)

    @property
    def focal(self) -> float:
        """Focal length in pixels, both axes: 75 degrees of horizontal field of view."""
        return 0.65 * self.width

    @property
    def camera(self) -> Camera:
        """Pinhole camera without distortion, at the identity pose. The principal point is slightly off centre."""
        centre = 0.504 * self.width, 0.495 * self.height
        return Camera(torch.eye(4, dtype=torch.float64), self.focal, self.focal, *centre, self.width, self.height)

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project (M, 2) directions (x/z, y/z), OpenCV axes, to (M, 2) distorted pixels; pixel centres are at +0.5."""
        return self.distortion.project(points, self.camera)

    def rays(self, pose: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (M, 3) unit ray directions of (M, 2) distorted pixels; ``pose`` (4, 4) is camera to world."""
        x, y = self._undistort(pixels).T
        local = np.stack([x, -y, -np.ones_like(x)], axis=1)
        local /= np.sqrt(np.einsum("nc,nc->n", local, local))[:, None]
        return local @ pose[:3, :3].T

    def _undistort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) distorted pixels to (M, 2) directions (x/z, y/z), the inverse of :meth:`pixels`.

        The fixed-point iteration converges because the distortion is small.
        """
        middle = [self.camera.cx, self.camera.cy]
        bent = (pixels - middle) / self.focal
        points = bent.copy()
        for _ in range(60):
            excess = (self.pixels(points) - middle) / self.focal - bent
            points -= excess
            if np.abs(excess).max(initial=0.0) < 1e-13:
                break
        return points

    def ray_bands(self, pose: NDArray[np.float64], samples: int) -> Iterator[NDArray[np.float64]]:
        """Yield (N, 3) unit ray directions of the image, a band of pixel rows at a time.

        Each pixel has ``samples`` x ``samples`` rays. ``pose`` (4, 4) is camera to world.
        """
        across = (np.arange(self.width * samples) + 0.5) / samples
        down = (np.arange(self.height * samples) + 0.5) / samples
        rows = max(1, RAYS_AT_ONCE // (len(across) * samples)) * samples
        for top in range(0, len(down), rows):
            x, y = np.meshgrid(across, down[top : top + rows])
            yield self.rays(pose, np.stack([x, y], axis=-1).reshape(-1, 2))


def room_lens(settings: RoomSettings) -> RoomLens:
    """Return the lens for the images of ``scene=room``."""
    return RoomLens(settings.size, LENS if settings.distortion else RadialDistortion())


def photograph_room(
    room: Room, lens: RoomLens, pose: NDArray[np.float64], supersampling: int, gain: float = 1.0
) -> NDArray[np.uint8]:
    """Render a photograph, (H, W, 3) uint8 sRGB, from ``pose``, (4, 4) camera to world with OpenGL axes.

    The rays of a pixel are averaged in linear light, then multiplied by the exposure factor ``gain``.
    """
    bands = (room_lamplight_radiance(room, pose[:3, 3], d) for d in lens.ray_bands(pose, supersampling))
    mean = np.concatenate([average_scene_rays(band, lens.width, supersampling) for band in bands])
    return np.round(encode_scene_srgb(mean * np.float32(gain)) * 255).astype(np.uint8)


# ---------------------------------------------------------------- the walk


def room_walk_positions(train: int, test: int) -> dict[str, NDArray[np.float64]]:
    """Return the positions of the views along the camera's walk, 0..1: {"train": (train,), "test": (test,)}.

    Test views are evenly spaced, and training views lie between the test views.
    """
    held_out = (np.arange(test) + 0.5) / test
    gap = np.arange(train) * test // train
    first = np.searchsorted(gap, gap)
    within = (np.arange(train) - first + 1) / (np.bincount(gap, minlength=test)[gap] + 1)
    return {"train": (gap - 0.5 + within) / test, "test": held_out}


def room_camera_poses(train: int, test: int) -> dict[str, list[NDArray[np.float64]]]:
    """Return split -> (4, 4) camera-to-world matrices, OpenGL axes. Test poses do not depend on ``train``."""
    poses = {}
    for split, times in room_walk_positions(train, test).items():
        shake = 2 * np.random.default_rng(_WALKS_SEEDS[split]).random((len(times), 7)) - 1
        poses[split] = [_walk_pose(float(t), s) for t, s in zip(times, shake, strict=True)]
    return poses


def _walk_pose(t: float, shake: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) camera-to-world matrix at position ``t``, 0..1, of a walk twice around the solids.

    ``shake`` (7,), random numbers -1..1, disturbs position (3), aim (3) and roll (1).
    """
    turn = 2 * math.pi
    distance = 3.55 + 0.8 * math.sin(turn * (5 * t + 0.15)) + 0.12 * shake[0]
    height = 1.1 - 0.6 * math.cos(turn * t) + 0.1 * math.sin(turn * 7 * t) + 0.06 * shake[1]
    azimuth = turn * 2 * t + 0.06 * shake[2]
    across = math.sqrt(distance**2 - height**2)
    eye = np.array([across * math.cos(azimuth), across * math.sin(azimuth), height])
    aim = 0.14 * shake[3:6] + [0, 0, -0.05]
    roll = math.radians(2.5) * shake[6]
    sideways = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = math.cos(roll) * np.array([0, 0, 1.0]) + math.sin(roll) * sideways
    view = look_at(*(torch.from_numpy(np.asarray(v, dtype=np.float64)) for v in (eye, aim, up)))
    return torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])


# ---------------------------------------------------------------- reconstructed points


class ReconstructedPoints(NamedTuple):
    """N points of a simulated structure-from-motion reconstruction."""

    # surface, position: (N, 3) float64, true positions, and positions with the errors of the reconstruction
    surface: NDArray[np.float64]
    position: NDArray[np.float64]
    # (N, 3) uint8 sRGB colour of the surface as seen by ``camera``, without the exposure factor of that camera's image
    rgb: NDArray[np.uint8]
    camera: NDArray[np.intp]  # (N,) index of the training camera that found the point


def reconstruct_room_points(
    room: Room,
    lens: RoomLens,
    poses: Sequence[NDArray[np.float64]],
    luma: Callable[[int], NDArray[np.float32]],
    count: int,
) -> ReconstructedPoints:
    """Simulate structure from motion: return ``count`` points, with errors, that two or more training cameras see.

    Points are drawn where the images have detail; ``luma`` maps a camera's index to the (H, W) brightness. ``poses``
    (4, 4) are camera to world. Raises ConfigError if too few surfaces are seen by two cameras.
    """
    chances = [_room_pixel_detail_chances(luma(i)) for i in range(len(poses))]
    directions, finders = np.zeros((0, 3)), np.zeros(0, np.intp)
    each = -(-count // len(poses))
    for attempt in range(_ROUNDS):
        random = np.random.default_rng([_POINTS_SEED, attempt])
        for camera, pose in enumerate(poses):
            numbers = random.random((each, 3))
            index = np.searchsorted(chances[camera], numbers[:, 0], side="right").clip(max=len(chances[camera]) - 1)
            pixels = np.stack([index % lens.width + numbers[:, 1], index // lens.width + numbers[:, 2]], axis=1)
            rays = lens.rays(pose, pixels)
            rays = rays[_room_seen_by_another(room, lens, poses, camera, rays)]
            directions = np.concatenate([directions, rays])
            finders = np.concatenate([finders, np.full(len(rays), camera)])
        if len(directions) >= count:
            break
    else:
        raise ConfigError(
            f"scene.points={count}: only {len(directions)} points are visible in two of {len(poses)} training views; "
            "expected fewer points or more views"
        )
    random = np.random.default_rng([_POINTS_SEED, _ROUNDS])
    chosen = np.sort(random.permutation(len(directions))[:count])
    directions, finders = directions[chosen], finders[chosen]
    origins = np.stack([p[:3, 3] for p in poses])[finders]
    hits = room.intersect(origins, directions)
    colours = encode_scene_srgb(room_lamplight_radiance(room, origins, directions))
    surface, depth = hits.position.astype(np.float64), hits.distance.astype(np.float64)[:, None]
    position = surface + depth * NOISE / np.sqrt(3) * random.standard_normal(surface.shape)
    wrong = np.zeros((count, 1), dtype=np.bool_)
    wrong[random.permutation(count)[: round(OUTLIERS * count)]] = True
    position = np.where(wrong, origins + random.uniform(0.25, 0.9, (count, 1)) * depth * directions, position)
    return ReconstructedPoints(surface, position, np.round(colours * 255).astype(np.uint8), finders)


def _room_pixel_detail_chances(luma: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (H * W,) cumulative probabilities for drawing pixels: pixels with brightness gradients are more likely."""
    down, across = np.gradient(luma.astype(np.float64))
    detail = np.hypot(down, across)
    total = np.cumsum((detail + _PLAIN * max(detail.mean(), 1e-6)).ravel())
    return total / total[-1]


def _room_seen_by_another(
    room: Room, lens: RoomLens, poses: Sequence[NDArray[np.float64]], camera: int, directions: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return (M,) bool: whether the surface hit by each ray from ``camera`` is visible in another camera's image."""
    hits = room.intersect(poses[camera][:3, 3], directions)
    starts = hits.lifted()
    seen = np.zeros(len(starts), dtype=np.bool_)
    for other, pose in enumerate(poses):
        rows = np.flatnonzero(~seen)
        if other == camera or not len(rows):
            continue
        local = (hits.position[rows] - pose[:3, 3]) @ pose[:3, :3]
        before = local[:, 2] < -1e-3
        rows, local = rows[before], local[before]
        x, y = lens.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:]).T
        rows = rows[(x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height)]
        seen[rows] = ~room.occluded(starts[rows], pose[:3, 3] - starts[rows], 1.0)
    visible = np.zeros(len(directions), dtype=np.bool_)
    visible[hits.hit] = seen
    return visible


# ---------------------------------------------------------------- rays in the room

_GRAZING = np.float32(0.04)  # least cosine of the angle of incidence in the width of a ray's footprint


class Room(Scene):
    """Scene of solids and furnishings. Textures are averaged over the footprints of rays, which prevents aliasing.

    A footprint is the area of the surface that one ray represents. ``spacing`` is the distance between neighbouring
    rays at distance 1 from the camera.
    """

    def __init__(
        self, solids: Sequence[Solid], around: Sequence[Furnishing], spacing: float, engine: Engine = "auto"
    ) -> None:
        black = uniform_colour("#000000")
        super().__init__([*solids, *(Solid(f.name, f.mesh, black, f.gloss) for f in around)], engine)
        self.glow = np.array([0.0] * len(solids) + [f.glow for f in around], dtype=np.float32)
        self._textures: list[Texture | None] = [*(None for _ in solids), *(f.texture for f in around)]
        self._spacing = np.float32(spacing)

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the first hits as :meth:`Scene.intersect` does; directions must have unit length."""
        hits = super().intersect(origins, directions)
        towards = np.asarray(directions, dtype=np.float32)[hits.hit]
        # The footprint is an ellipse; the width is the root of its area, so grazing views blur instead of flickering.
        root: NDArray[np.float32] = np.sqrt(np.maximum(np.abs(shading_dot(hits.face, towards)), _GRAZING))
        width = hits.distance * self._spacing / root
        albedo = hits.albedo.copy()
        for index in np.unique(hits.solid):
            if (texture := self._textures[index]) is not None:
                mine = np.flatnonzero(hits.solid == index)
                albedo[mine] = texture(hits.position[mine], width[mine])
        return replace(hits, albedo=albedo)


def room_lamplight_radiance(room: Room, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float32]:
    """Shade N rays in the room: return (N, 3) linear RGB. ``origins``: (N, 3) or (3,); ``directions``: unit (N, 3)."""
    d = np.asarray(directions, dtype=np.float32)
    hits = room.intersect(origins, d)
    to_eye = -d[hits.hit]
    to_lamp = np.array(LAMP, dtype=np.float32) - hits.position
    away = np.sqrt(shading_dot(to_lamp, to_lamp))
    to_lamp /= away[:, None]
    beside_bulb = np.maximum(away - np.float32(1.2 * BULB), 0)  # the bulb itself is no obstacle
    lit = scene_light_visibility(room, hits, to_lamp, beside_bulb)
    rgb = reflect_light(hits, to_eye, to_lamp) * (np.array(LAMP_POWER, dtype=np.float32) * (lit / away**2)[:, None])
    add_scene_surroundings(rgb, hits, to_eye, ABOVE, BELOW)
    glow = room.glow[hits.solid][:, None]
    image = np.zeros(d.shape, dtype=np.float32)
    image[hits.hit] = np.where(glow > 0, glow * hits.albedo, rgb)
    return image
