"""Pixels of image files become floats late, to the same bits: of whole images, strided views and alpha alone."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.cameras import Camera
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Pixels
from neuprim.core.data import image_views as module
from neuprim.core.data.image_views import ImageFrame, ImageViews, Mask, RadialDistortion, StoredPixels
from neuprim.core.errors import DataError
from neuprim.core.io.exr import write_exr
from neuprim.core.io.images import image_info, srgb_to_linear
from neuprim.core.train.training_views import PixelLoader
from tests.core import tiny

W, H = 47, 38
LENS = RadialDistortion(k1=-0.1)


def image_views(folder: Path, kind: str, count: int = 1) -> ImageViews:
    """Random images of a kind: channels, then what is done to them."""
    rng, frames = np.random.default_rng(len(kind)), []
    for i in range(count):
        file = folder / (f"{i}.exr" if "exr" in kind else f"{i}.png")
        values = rng.integers(0, 256, (H, W, 4 if "rgba" in kind else 3), dtype=np.uint8)
        if "exr" in kind:
            write_exr(
                file,
                torch.from_numpy(values / 255.0).float() * torch.tensor([3.0, 2.0, 1.0, 1.0])[: values.shape[-1]],
                half="float" not in kind,
            )
        else:
            Image.fromarray(values).save(file)
        mask = None
        if "masked" in kind:
            Image.fromarray(rng.integers(0, 2, (H, W), dtype=np.uint8) * 255).save(folder / f"mask_{i}.png")
            mask = Mask(folder / f"mask_{i}.png")
        camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 40.0, W / 2, H / 2, W, H)
        lens = LENS if "lens" in kind else None
        frames.append(ImageFrame(str(i), file, camera, image_info(file), mask, lens))
    views = ImageViews(frames, 2 if "half" in kind else 1, to_linear="linear" in kind)
    views.scale = 0.37 if "linear" in kind else 1.0
    return views


def whole_pixels(views: ImageViews) -> Pixels:
    """The definition: everything is converted at once."""
    stored = views._load_image(0)
    data, eight_bit = stored.data, stored.data.dtype == torch.uint8
    values = data.float() / 255.0 if eight_bit else data.float()
    alpha = values[..., 3] if data.shape[-1] == 4 else None
    rgb = values[..., :3]
    if views._to_linear:
        rgb = srgb_to_linear(torch.arange(256) / 255.0)[data[..., :3].int()] if eight_bit else rgb
        rgb = rgb if stored.premultiplied or alpha is None else rgb * alpha[..., None]
        rgb = rgb * views.scale
    elif alpha is not None and not stored.premultiplied:
        level = np.float32(1.0 / 255.0)
        plain = data.numpy().astype(np.float32) * level
        rgb, alpha = torch.from_numpy(plain[..., :3] * plain[..., 3:]), torch.from_numpy(plain[..., 3])
    return Pixels(rgb, alpha, stored.mask)


def same(found: torch.Tensor | None, expected: torch.Tensor | None) -> bool:
    if found is None or expected is None:
        return found is expected
    return found.dtype == expected.dtype and found.is_contiguous() and torch.equal(found, expected)


@pytest.mark.parametrize(
    "kind",
    """rgb rgba rgb-masked rgba-masked rgb-linear rgba-linear rgba-half rgb-half-masked rgb-lens rgba-lens-masked
    rgba-linear-half rgb-linear-lens exr-rgb exr-rgba exr-rgba-linear exr-rgb-linear-half exr-rgba-float""".split(),
)
def test_a_strided_view_has_the_bits_of_the_whole_image(kind: str, tmp_path: Path) -> None:
    views = image_views(tmp_path, kind)
    whole = whole_pixels(views)
    for step, column, row in ((1, 0, 0), (2, 1, 0), (3, 0, 2), (7, 6, 5)):
        found, chosen = views.pixels(0).strided(step, column, row), (slice(row, None, step), slice(column, None, step))
        for name in ("alpha", "rgb", "mask"):
            value = getattr(whole, name)
            assert same(getattr(found, name), None if value is None else value[chosen].contiguous()), (name, step)
    plain, background = views.pixels(0), torch.tensor([0.2, 0.5, 0.9])
    assert torch.equal(plain.over(background), whole.over(background))
    assert same(plain.rgb, whole.rgb.contiguous()) and same(plain.mask, whole.mask)


def test_only_what_is_used_is_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, kernel = [], module._premultiply_dataset_kernel
    monkeypatch.setattr(module, "_premultiply_dataset_kernel", lambda x, *y: sizes.append(len(x)) or kernel(x, *y))
    pixels = image_views(tmp_path, "rgba").pixels(0)
    few = pixels.strided(5, 0, 0)
    assert few.alpha is not None and pixels.alpha is not None and not sizes, "silhouettes need no colours"
    assert few.rgb is few.rgb and sizes == [10 * 8]


def test_a_training_on_the_cpu_gets_whole_views_unconverted(tmp_path: Path) -> None:
    views = image_views(tmp_path, "rgba")
    loader = PixelLoader(tiny.two_primitives(train=views), torch.device("cpu"))
    taken = loader.take(0, 0)
    assert isinstance(taken, StoredPixels) and not {"rgb", "alpha"} & set(vars(taken))


def test_fields_can_be_replaced(tmp_path: Path) -> None:
    pixels, mask = image_views(tmp_path, "rgba").pixels(0), torch.rand(H, W) < 0.5
    masked = replace(pixels, mask=mask)
    few = masked.strided(3, 1, 2)
    assert torch.equal(masked.rgb, pixels.rgb) and few.mask is not None and torch.equal(few.mask, mask[2::3, 1::3])
    assert torch.equal(few.rgb, pixels.rgb[2::3, 1::3]) and few.alpha is not None


@pytest.mark.parametrize("threads", [1, 3])
def test_damaged_images_are_named_in_order_by_any_number_of_threads(
    threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, used, read = image_views(tmp_path, "rgb", 9), set(), module.read_image
    for i in (7, 2, 5):
        views.file(i).write_bytes(b"\x89PNG\r\n\x1a\n")
    fractions: list[float] = []

    def spy(*arguments):  # type: ignore[no-untyped-def]
        used.add(threading.get_ident())
        return read(*arguments)

    monkeypatch.setattr(module, "read_image", spy)
    with limit_threads(threads):
        faults = views.preload(fractions.append)
    assert list(faults) == [2, 5, 7] and all(isinstance(fault, DataError) for fault in faults.values())
    assert fractions == sorted(fractions) and len(fractions) == 9 and len(used) <= threads
    assert isinstance(views.pixels(0), StoredPixels)
