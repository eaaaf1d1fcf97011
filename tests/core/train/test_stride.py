"""Strided training views: the rays of the pixels they keep, a choice from sizes alone, masks and alpha."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neuprim.core.data import Dataset, Pixels
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.train import training_views
from neuprim.core.train.training_views import PixelStride, choose_stride, count_covered_pixels, draw_stride
from tests.core import tiny


@pytest.fixture(scope="module")
def plain() -> Dataset:
    return tiny.two_primitives()


@pytest.mark.parametrize("stride", [PixelStride(2, 0, 1), PixelStride(3, 2, 0), PixelStride(5, 4, 3)])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_strided_view_has_the_pixels_of_the_whole_one(stride: PixelStride, backend: str, plain: Dataset) -> None:
    view, pixels = plain.train.view(1), plain.train.pixels(1)
    mask = torch.rand(pixels.rgb.shape[:2], generator=torch.Generator().manual_seed(1)) < 0.5
    few_view, few = stride.take(view, replace(pixels, mask=mask))
    rows, columns = slice(stride.row, None, stride.step), slice(stride.column, None, stride.step)
    settings = RenderSettings(backend=backend, alpha_min=0.0)
    whole, part = (render_lowered(tiny.truth(), each.camera, settings).rgb for each in (view, few_view))
    torch.testing.assert_close(part, whole[rows, columns], atol=2e-6, rtol=0)
    assert pixels.alpha is not None and few.alpha is not None and few.mask is not None
    assert torch.equal(few.rgb, pixels.rgb[rows, columns]) and torch.equal(few.alpha, pixels.alpha[rows, columns])
    assert torch.equal(few.mask, mask[rows, columns])
    assert few.rgb.shape[:2] == (few_view.camera.height, few_view.camera.width)


def test_the_phases_of_a_stride_show_every_pixel_once(plain: Dataset) -> None:
    view, count = plain.train.view(0), torch.zeros(tiny.SIZE, tiny.SIZE, 1)
    numbers = torch.arange(tiny.SIZE**2).reshape(tiny.SIZE, tiny.SIZE, 1).float()
    for column in range(5):
        for row in range(5):
            _, few = PixelStride(5, column, row).take(view, Pixels(numbers))
            count.reshape(-1)[few.rgb.long().reshape(-1)] += 1
    assert bool((count == 1).all())


def test_the_automatic_stride_depends_on_sizes_and_gets_finer() -> None:
    unit = training_views._PIXELS_PER_PRIMITIVE
    shares = (0.0, 0.69, 0.7, 0.89, 0.9, 1.0)
    assert [choose_stride("auto", 1000 * unit * 16, 1000, share) for share in shares] == [4, 4, 2, 2, 1, 1]
    assert [choose_stride("auto", 1000 * unit * 9, 1000, share) for share in (0.0, 0.8, 0.9)] == [3, 2, 1]
    assert [choose_stride("auto", covered, 1000, 0.5) for covered in (0, 1000 * unit, 1000 * unit * 9)] == [1, 1, 3]
    assert {choose_stride(3, 1e9, 10, p) for p in (0.0, 0.95)} == {3}


def test_covered_pixels_show_something_and_are_not_masked(plain: Dataset) -> None:
    alphas = [plain.train.pixels(i).alpha for i in range(len(plain.train))]
    assert count_covered_pixels(plain.train) == sum(int((a > 0).sum()) for a in alphas if a is not None) / len(alphas)


def test_a_small_view_keeps_the_window_of_ssim(plain: Dataset) -> None:
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    view = plain.train.view(0)
    narrow = replace(view, camera=replace(view.camera, width=21))
    assert draw_stride(1, view, generator) == draw_stride(9, narrow, generator) == PixelStride()
    assert torch.equal(generator.get_state(), before), "whole views draw nothing"
    drawn = {draw_stride(9, view, generator) for _ in range(40)}
    assert drawn == {PixelStride(2, column, row) for column in range(2) for row in range(2)}


def test_steps_render_strided_views(plain: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from neuprim.core.train import trainer as module

    monkeypatch.setattr("neuprim.core.train.training_views._PIXELS_PER_PRIMITIVE", 1e-3)
    sizes, render = [], module.render

    def spy(model, camera, *rest):  # type: ignore[no-untyped-def]
        sizes.append(camera.width)
        return render(model, camera, *rest)

    monkeypatch.setattr(module, "render", spy)
    assert all(report.psnr > 0 for report in tiny.trainer(plain, 20, stride="auto").run())
    assert sizes == [tiny.SIZE // 2] * 18 + [tiny.SIZE] * 2
