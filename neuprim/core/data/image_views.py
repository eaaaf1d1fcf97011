"""View sets of posed image files, which are decoded on demand, masked, undistorted, down-sampled and cached."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import resolve_threads
from neuprim.core.data import Pixels, View, ViewSet
from neuprim.core.errors import ConfigError, DataError, warn_once
from neuprim.core.io.images import ImageInfo, read_image, read_mask_image, srgb_to_linear
from neuprim.core.model.fields import Conditions

__all__ = ["Distortion", "FisheyeDistortion", "ImageFrame", "ImageViews", "Mask", "RadialDistortion", "find_masks"]


class Distortion(ABC):
    """Base class of lens distortions; instances are hashable, so views with equal lenses share a resampling grid."""

    @abstractmethod
    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        """Project (M, 2) directions (x/z, y/z) to (M, 2) pixels of the photograph, float64; pixel centres at +0.5."""


@dataclass(frozen=True)
class RadialDistortion(Distortion):
    """OpenCV's lens model: the radius r becomes r (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8), plus tangential terms.

    p1 and p2 are the tangential coefficients.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        x, y = points[:, 0], points[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        yd = y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)


@dataclass(frozen=True)
class FisheyeDistortion(Distortion):
    """OpenCV's fisheye lens: the angle t to the axis becomes the radius t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        r = np.hypot(points[:, 0], points[:, 1])
        t = np.arctan(r)
        t2 = t * t
        bent = t * (1.0 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-12)
        return points * scale[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def undistortion_grid(camera: Camera, distortion: Distortion) -> tuple[Tensor, Tensor]:
    """Return the positions of the undistorted ``camera``'s pixels in a distorted photograph of equal size, and a mask.

    Positions are (H, W, 2) float32 pixels (x, y), centres at +0.5. The mask is (H, W) bool: True for positions inside
    the photograph, in the region around the principal point where the lens distortion does not fold the image over.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    points = np.stack(np.meshgrid(x, y), axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        source = distortion.project(points.reshape(-1, 2), camera).reshape(points.shape)
        valid = _unfolded_pixels(camera, source)
        valid &= ((source >= 0.0) & (source <= (camera.width, camera.height))).all(axis=-1)
    # far-off and infinite targets are masked, but must stay finite for the sampler
    source = np.nan_to_num(source, nan=-1.0, posinf=-1.0, neginf=-1.0).clip(-1e6, 1e6)
    return torch.from_numpy(source.astype(np.float32)), torch.from_numpy(valid)


def _unfolded_pixels(camera: Camera, source: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: pixels connected to the principal point without crossing a fold of the lens distortion.

    ``source`` (H, W, 2) has the pixels' positions in the photograph. At a fold, the order of these positions reverses.
    """
    # polynomial lens models turn back beyond some radius and would mirror the middle of the photograph into the corners
    if min(source.shape[:2]) < 2:
        return np.isfinite(source).all(axis=-1)
    dy, dx = np.gradient(source, axis=(0, 1))
    upright = dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0] > 0.0
    regions, _ = ndimage.label(upright)
    row, column = (min(max(int(c), 0), n - 1) for c, n in ((camera.cy, camera.height), (camera.cx, camera.width)))
    return (regions == regions[row, column]) & upright


def resample_image(image: Tensor, source: Tensor) -> Tensor:
    """Sample an (H, W, C) image bilinearly at the (H', W', 2) pixel positions ``source`` (x, y), centres at +0.5.

    Returns (H', W', C) float32. Positions outside the image are clamped to its border.
    """
    height, width = image.shape[:2]
    grid = source / torch.tensor([width, height]) * 2.0 - 1.0  # -1 and 1 are the outer edges of the outer pixels
    planes = image.float().permute(2, 0, 1)[None]
    out = F.grid_sample(planes, grid[None], mode="bilinear", padding_mode="border", align_corners=False)
    return out[0].permute(1, 2, 0).contiguous()


@dataclass(frozen=True)
class Mask:
    """A mask file: pixels of value zero are ignored."""

    path: Path
    inverted: bool = False  # ignore pixels that are not zero instead


def find_masks(folder: Path, files: Sequence[Path], images: Path | None = None) -> list[Mask | None]:
    """Return a mask, or None, for each image file; report the number of masks as a warning.

    The mask of ``images/a/b.jpg`` is ``masks/a/b.png``, ``masks/a/b.jpg.png`` or ``masks/a/b.jpg`` (COLMAP,
    nerfstudio). For ``images_4``, ``masks_4`` is tried first. ``dynamic_mask_b.png`` next to the image (instant-ngp) is
    an inverted mask: its non-zero pixels are ignored.

    Args:
        folder: folder of the data set.
        images: folder of the images. None: the subfolder of ``folder`` whose name begins with "images" in an image's
            path, else ``folder``.
    """
    masks = [_find_mask(folder, file, images) for file in files]
    found = [m for m in masks if m is not None]
    if found:
        what = f"pixels that are {'not ' if found[0].inverted else ''}black in a mask are ignored"
        warn_once(f"{found[0].path.parent}: found masks for {len(found)} of {len(files)} images; {what}")
    return masks


def _find_mask(folder: Path, file: Path, images: Path | None) -> Mask | None:
    try:
        if images is None:
            first = file.relative_to(folder).parts[0]
            images = folder / first if first.startswith("images") and first != file.name else folder
        name = file.relative_to(images)
    except ValueError:  # an image outside of the folder
        return None
    own = images.name.replace("images", "masks", 1) if images.name.startswith("images") else "masks"
    for place in dict.fromkeys((own, "masks")):
        for candidate in (name.with_suffix(".png"), name.with_name(name.name + ".png"), name):
            if (folder / place / candidate).is_file():
                return Mask(folder / place / candidate)
    dynamic = file.with_name(f"dynamic_mask_{file.stem}.png")
    return Mask(dynamic, inverted=True) if dynamic.is_file() else None


def average_pixels(values: Tensor, factor: int) -> Tensor:
    """Average an (H, W, C) image over blocks of ``factor`` x ``factor`` pixels, to (H // factor, W // factor, C).

    Remaining rows and columns are cut off.
    """
    return F.avg_pool2d(values.permute(2, 0, 1), factor).permute(1, 2, 0).contiguous()


def reduce_image_mask(mask: Tensor, factor: int) -> Tensor:
    """Reduce an (H, W) mask to (H // factor, W // factor) bool: True where all factor x factor pixels are True."""
    return F.avg_pool2d(mask[None].float(), factor)[0] > 0.999


_CACHE_BYTES = 2 * 2**30
_GRIDS = 4
_BYTE = 1.0 / 255.0
_LINEAR = srgb_to_linear(torch.arange(256) / 255.0)


@cache
def _linear_table(where: torch.device) -> Tensor:
    return _LINEAR.to(where)


@dataclass(frozen=True)
class ImageFrame:
    """An image file with its camera, lens and conditions."""

    name: str  # unique within its split
    path: Path
    camera: Camera  # undistorted camera at the size of the file
    info: ImageInfo  # what image_info returns
    mask: Mask | None = None
    distortion: Distortion | None = None  # lens of the photograph; None for a pinhole
    conditions: Conditions = field(default_factory=dict)  # time, light, ...; empty for static scenes


@exact_kernel
def _premultiply_dataset_kernel(rgba, rgb, alpha):  # type: ignore[no-untyped-def]
    scale = np.float32(1.0 / 255.0)
    for i in range(rgba.shape[0]):
        a = np.float32(rgba[i, 3]) * scale
        alpha[i] = a
        for c in range(3):
            rgb[i, c] = np.float32(rgba[i, c]) * scale * a


@dataclass(frozen=True)
class _StoredImage:
    """A decoded image: (H, W, C) uint8, half or float, perhaps premultiplied by alpha, and a mask of valid pixels."""

    data: Tensor
    premultiplied: bool
    mask: Tensor | None
    to_linear: bool = False  # whether 8-bit colours are converted to linear light
    scale: float = 1.0  # factor on the colours, after to_linear

    def to(self, where: torch.device) -> _StoredImage:
        """Return a copy on another device; the copy may be asynchronous."""
        mask = None if self.mask is None else device.copy_to_device(self.mask, where)
        return replace(self, data=device.copy_to_device(self.data, where), mask=mask)

    @property
    def nbytes(self) -> int:
        return self.data.nbytes + (0 if self.mask is None else self.mask.nbytes)

    def strided(self, step: int, column: int, row: int) -> _StoredImage:
        data, words = self.data, self.data.dtype == torch.uint8 and self.data.shape[-1] == 4
        few = Pixels(data.view(torch.int32) if words else data, None, self.mask).strided(step, column, row)
        return replace(self, data=few.rgb.view(data.dtype), mask=few.mask)  # pixels of four bytes move as one number

    @property
    def alpha(self) -> Tensor | None:
        """Alpha 0..1, (H, W) float32; None if the image has no alpha channel."""
        if self.data.shape[-1] == 3:
            return None
        alpha = self.data[..., 3].float()
        if self.data.dtype == torch.uint8:
            alpha = alpha * _BYTE if self._multiplies_alpha else alpha / 255.0
        return alpha.contiguous()

    def planes(self) -> tuple[Tensor, Tensor | None]:
        """Return premultiplied colours (H, W, 3) and alpha (H, W) or None, both float32."""
        rgb, eight_bit, alpha = self.data[..., :3], self.data.dtype == torch.uint8, self.alpha
        if self._multiplies_alpha:
            assert alpha is not None
            if not device.on_numba(self.data):
                return rgb.float() * _BYTE * alpha[..., None], alpha
            made = torch.empty(*self.data.shape[:2], 3)  # in one pass, as every step needs them
            outputs = made.reshape(-1, 3).numpy(), alpha.reshape(-1).numpy()
            _premultiply_dataset_kernel(self.data.reshape(-1, 4).numpy(), *outputs)
            return made, alpha
        if not self.to_linear:
            return (rgb / 255.0 if eight_bit else rgb.float()).contiguous(), alpha
        rgb = _linear_table(rgb.device)[rgb.int()] if eight_bit else rgb.float()
        rgb = rgb if self.premultiplied or alpha is None else rgb * alpha[..., None]
        return (rgb * self.scale).contiguous(), alpha

    @property
    def _multiplies_alpha(self) -> bool:
        """Whether the colours are 8-bit sRGB values that must be multiplied with alpha."""
        return not (self.premultiplied or self.to_linear or self.data.shape[-1] == 3)


class StoredPixels(Pixels):
    """Pixels of a decoded image, mostly 8-bit, that are converted to floats on first use.

    After :meth:`strided`, only the chosen pixels are converted. Reading only alpha converts only alpha. A copy on a GPU
    also stays 8-bit until its first use, because 8 bits take a quarter of the memory of floats.

    Args:
        image: the decoded image; None if ``fields`` has the fields of ``Pixels``, as :func:`dataclasses.replace`
            passes them.
    """

    image: _StoredImage | None

    def __init__(self, image: _StoredImage | None = None, **fields: Any) -> None:
        self.__dict__.update(fields if image is None else {"mask": image.mask}, image=image)

    def to(self, where: torch.device) -> Pixels:
        return super().to(where) if self.image is None else StoredPixels(self.image.to(where))

    @cached_property
    def rgb(self) -> Tensor:  # type: ignore[override]
        assert self.image is not None
        rgb, self.__dict__["alpha"] = self.image.planes()
        return rgb

    @cached_property
    def alpha(self) -> Tensor | None:  # type: ignore[override]
        return None if self.image is None else self.image.alpha

    def strided(self, step: int, column: int, row: int) -> Pixels:
        if self.image is None:
            return super().strided(step, column, row)
        return StoredPixels(self.image.strided(step, column, row))


class ImageViews(ViewSet):
    """Views of image files: decoded on demand, masked, undistorted, down-sampled and cached. Thread-safe.

    Args:
        downsample: factor by which images are reduced; remaining rows and columns are cut off. An image smaller than
            the factor is a ConfigError.
        cache_bytes: most bytes of the cache, which holds decoded images as uint8 (PNG, JPEG) or half (OpenEXR).
        to_linear: convert sRGB files to linear light, before images are undistorted and reduced.
    """

    def __init__(
        self,
        frames: Sequence[ImageFrame],
        downsample: int = 1,
        cache_bytes: int = _CACHE_BYTES,
        to_linear: bool = False,
    ) -> None:
        self._frames = list(frames)
        self._to_linear = to_linear
        self.scale = 1.0  # factor of linear colours
        self._factor = downsample
        self._cameras = [_reduced_image_camera(f, downsample) for f in self._frames]
        self._cache_bytes = cache_bytes
        self._used = 0
        self._stored: dict[int, _StoredImage] = {}
        self._grids: dict[tuple[object, ...], tuple[Tensor, Tensor]] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._frames)

    def view(self, index: int) -> View:
        return View(self._frames[index].name, self._cameras[index], self._frames[index].conditions)

    def file(self, index: int) -> Path:
        """Return the image file of a view."""
        return self._frames[index].path

    def pixels(self, index: int) -> Pixels:
        """Return the pixels of a view; raise DataError if the file is missing, damaged, changed or wholly masked."""
        return StoredPixels(replace(self._load_image(range(len(self))[index]), scale=self.scale))

    def preload(
        self, progress: Callable[[float], None] = lambda fraction: None, empty: bool = True
    ) -> dict[int, DataError]:
        """Decode and cache all images; return the error of each damaged image by the index of its view.

        ``progress`` is called with the finished fraction. Unless ``empty``, a fully transparent image is an error.
        """

        def fault(index: int) -> DataError | None:
            try:
                data = self._load_image(index).data
            except DataError as error:
                return error
            if empty or data.shape[-1] == 3 or bool(data[..., 3].any()):
                return None
            return DataError(f"{self.file(index)}: image is fully transparent; expected at least one visible pixel")

        faults = {}
        with ThreadPoolExecutor(resolve_threads(0)) as pool:
            for index, error in enumerate(pool.map(fault, range(len(self)))):
                if error is not None:
                    faults[index] = error
                progress((index + 1) / len(self))
        return faults

    def drop(self, indices: Container[int]) -> None:
        """Remove the views at ``indices``; the indices of later views decrease."""
        left = [i for i in range(len(self)) if i not in indices]
        self._frames, self._cameras = [self._frames[i] for i in left], [self._cameras[i] for i in left]
        self._stored = {new: self._stored[old] for new, old in enumerate(left) if old in self._stored}

    def _load_image(self, index: int) -> _StoredImage:
        found = self._stored.get(index)
        if found is not None:
            return found
        stored = self._read_frame(self._frames[index])
        size = stored.data.nbytes + (0 if stored.mask is None else stored.mask.nbytes)
        with self._lock:
            if index not in self._stored and self._used + size <= self._cache_bytes:
                self._stored[index] = stored
                self._used += size
        return stored

    def _read_frame(self, frame: ImageFrame) -> _StoredImage:
        size = (frame.info.width, frame.info.height)
        image = read_image(frame.path, size)
        if image.shape[-1] != frame.info.channels or (image.dtype != torch.uint8) != frame.info.linear:
            raise DataError(f"{frame.path}: file changed since its first read; expected {frame.info.channels} channels")
        mask = None if frame.mask is None else read_mask_image(frame.mask.path, size) ^ frame.mask.inverted
        if frame.info.linear and image.shape[-1] == 4:
            alpha = image[..., 3]
            if not bool(((alpha >= -1e-3) & (alpha <= 1.001)).all()):
                found = f"an alpha value has magnitude {alpha.float().abs().max().item():.4g}"
                raise DataError(f"{frame.path}: {found}; expected 0..1")
        if frame.distortion is not None or self._factor > 1:
            image, mask = self._resample_frame(frame, image, mask)
            premultiplied = True
        else:
            premultiplied = frame.info.linear
        if mask is not None and not mask.any():
            raise DataError(f"{frame.path}: mask and lens distortion exclude all pixels; expected at least one pixel")
        if image.dtype == torch.float32 and image.abs().max() <= 65504.0:
            image = image.half()
        return _StoredImage(image, premultiplied, mask, self._to_linear)

    def _resample_frame(self, frame: ImageFrame, image: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Undistort and reduce an image and its mask; return premultiplied uint8 for 8-bit sRGB, else float32."""
        eight_bit = image.dtype == torch.uint8
        if eight_bit and self._to_linear:
            values = _LINEAR[image[..., :3].int()]
            if image.shape[-1] == 4:
                alpha = image[..., 3:] / 255.0
                values = torch.cat([values * alpha, alpha], dim=-1)
            eight_bit = False
        else:
            values = image.float()
        if eight_bit and values.shape[-1] == 4:
            values = torch.cat([values[..., :3] * (values[..., 3:] / 255.0), values[..., 3:]], dim=-1)
        if frame.distortion is not None:
            source, valid = self._lens_grid(frame.camera, frame.distortion)
            values = resample_image(values, source)
            mask = valid if mask is None else valid & (resample_image(mask[..., None].float(), source)[..., 0] > 0.999)
        n = self._factor
        if n > 1:
            values = average_pixels(values, n)
            mask = None if mask is None else reduce_image_mask(mask, n)
        return (values.round().clamp(0.0, 255.0).to(torch.uint8) if eight_bit else values), mask

    def _lens_grid(self, camera: Camera, distortion: Distortion) -> tuple[Tensor, Tensor]:
        key = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, distortion)
        with self._lock:
            if key not in self._grids:
                if len(self._grids) >= _GRIDS:  # captures with a lens per frame would otherwise keep one grid per image
                    self._grids.pop(next(iter(self._grids)))
                self._grids[key] = undistortion_grid(camera, distortion)
            return self._grids[key]


def _reduced_image_camera(frame: ImageFrame, factor: int) -> Camera:
    camera = frame.camera
    if min(camera.width, camera.height) < factor:
        found = f"{frame.path} has only {camera.width}x{camera.height} pixels"
        raise ConfigError(f"scene.downsample is {factor}, but {found}; expected a smaller scene.downsample")
    return camera.reduced(factor)
