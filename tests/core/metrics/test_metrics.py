"""PSNR and SSIM against hand-computed values and a plain numpy implementation."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from kornia.metrics import ssim as ssim_map
from scipy.signal import convolve2d

from neuprim.core.compute.threads import limit_threads
from neuprim.core.errors import DataError, NonFiniteError
from neuprim.core.metrics import (
    SSIM_SIGMA,
    SSIM_WINDOW,
    metric_from_json,
    metric_to_json,
    psnr,
    psnr_gain,
    ssim,
    ssim_3dgs,
)
from neuprim.core.metrics.image import format_failed_views, format_metrics


def pair(
    height: int, width: int, channels: int, noise: float = 0.1, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth image with an edge, and the same with noise."""
    rng = np.random.default_rng(seed)
    y, x, c = np.mgrid[:height, :width, :channels]
    base = 0.5 + 0.3 * np.sin(x / 3.0) * np.cos(y / 4.0 + c) + 0.2 * (x > width // 2)
    return torch.from_numpy(base + noise * rng.standard_normal(base.shape)), torch.from_numpy(base)


def plain_ssim(a: np.ndarray, b: np.ndarray, window: int, peak: float = 1.0) -> float:
    """Loops over every window position; weighted moments straight from the definition."""
    taps = np.exp(-((np.arange(window) - window // 2) ** 2) / (2 * SSIM_SIGMA**2))
    weights = np.outer(taps, taps)[..., None] / taps.sum() ** 2
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    values = []
    for i, j in np.ndindex(a.shape[0] - window + 1, a.shape[1] - window + 1):
        p, q = a[i : i + window, j : j + window], b[i : i + window, j : j + window]
        mp, mq = (weights * p).sum((0, 1)), (weights * q).sum((0, 1))
        vp, vq = (weights * (p - mp) ** 2).sum((0, 1)), (weights * (q - mq) ** 2).sum((0, 1))
        cov = (weights * (p - mp) * (q - mq)).sum((0, 1))
        values.append((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return float(np.mean(values))


def test_psnr_mask_selects_pixels() -> None:
    truth = torch.zeros(2, 3, 3)
    rendered = truth.clone()
    rendered[0, 0] = 0.1
    rendered[1, 2] = 100.0
    mask = torch.zeros(2, 3, dtype=torch.bool)
    mask[0, 0] = True
    assert psnr(rendered, truth, mask) == pytest.approx(20.0, abs=1e-5)
    mask[0, 1] = True
    assert psnr(rendered, truth, mask) == pytest.approx(20.0 + 10 * math.log10(2), abs=1e-5)


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e15])
def test_psnr_equals_the_formula_in_float64(channels: int, scale: float) -> None:
    """More pixels than are summed at a time; dtypes, masks and layouts."""
    rendered, truth = (scale * image for image in pair(230, 190, channels))
    mask = torch.rand(230, 190, generator=torch.Generator().manual_seed(3)) < 0.3
    turned = rendered.float().transpose(0, 1).contiguous().transpose(0, 1)
    for first, second in (
        (rendered, truth),
        (rendered.float(), truth.float()),
        (turned, truth),
        (turned, truth.half()),
    ):
        if not bool(torch.isfinite(second).all()):
            continue
        squares = (first.double() - second.double()).square()
        for chosen in (None, mask, mask.T.contiguous().T):
            mean = float((squares if chosen is None else squares[chosen]).mean())
            found = psnr(first, second, chosen, peak=2.0)
            assert found == pytest.approx(20 * math.log10(2.0) - 10 * math.log10(mean), abs=1e-9)
            with limit_threads(1):
                assert psnr(first, second, chosen, peak=2.0) == found, "any number of threads gives the same bits"


def test_large_finite_values_are_not_taken_for_infinite() -> None:
    image = torch.full((12, 12, 3), 3e38)
    assert psnr(image, image) == math.inf and psnr(image, -image) < -700
    bad, hidden = image.clone(), torch.ones(12, 12, dtype=torch.bool)
    bad[2, 3, 1], hidden[2, 3] = math.inf, False
    with pytest.raises(NonFiniteError, match="truth image: 1 of 432"):
        psnr(image, bad, hidden)


def test_identical_images() -> None:
    image, _ = pair(20, 17, 3)
    assert psnr(image, image) == math.inf
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    black = torch.zeros(16, 16, 3)
    assert ssim(black, black) == 1.0


@pytest.mark.parametrize(
    ("height", "width", "window"), [(11, 11, 11), (10, 30, 9), (9, 12, 9), (30, 4, 3), (2, 2, 1), (1, 1, 1)]
)
def test_ssim_window_shrinks_to_fit(height: int, width: int, window: int) -> None:
    rendered, truth = pair(height, width, 3)
    assert ssim(rendered, truth) == pytest.approx(plain_ssim(rendered.numpy(), truth.numpy(), window), abs=1e-12)


@pytest.mark.parametrize(("height", "width", "channels"), [(23, 19, 3), (12, 30, 1), (8, 5, 3)])
def test_ssim_of_3dgs_equals_a_convolution_over_black(height: int, width: int, channels: int) -> None:
    """scipy's convolution of the same size with zeros around the image, from the formula of E[x²] − E[x]²."""
    rendered, truth = (image.clamp(0, 1) for image in pair(height, width, channels, seed=height))
    x = np.arange(11) - 5
    taps = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    values = []
    for p, q in zip(rendered.permute(2, 0, 1).numpy(), truth.permute(2, 0, 1).numpy(), strict=True):
        mp, mq, pp, qq, pq = (convolve2d(z, window, "same", "fill", 0) for z in (p, q, p * p, q * q, p * q))
        values.append(
            (2 * mp * mq + 1e-4)
            * (2 * (pq - mp * mq) + 9e-4)
            / ((mp**2 + mq**2 + 1e-4) * (pp - mp**2 + qq - mq**2 + 9e-4))
        )
    assert ssim_3dgs(rendered, truth) == pytest.approx(float(np.mean(values)), abs=1e-12)
    assert abs(ssim_3dgs(rendered, truth) - ssim(rendered, truth)) > 1e-3, "another convention"
    assert ssim_3dgs(truth, truth) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("rendered", "truth", "text"),
    [
        (torch.zeros(4, 4, 3), torch.zeros(4, 5, 3), r"\(4, 4, 3\).*\(4, 5, 3\)"),
        (torch.zeros(4, 4), torch.zeros(4, 4), r"rendered image.*\(H, W, C\).*\(4, 4\)"),
        (torch.zeros(0, 4, 3), torch.zeros(0, 4, 3), "at least one pixel"),
        (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3, dtype=torch.uint8), "truth image.*uint8"),
    ],
)
def test_wrong_shapes_and_types_are_named(rendered: torch.Tensor, truth: torch.Tensor, text: str) -> None:
    for metric in (psnr, ssim):
        with pytest.raises(DataError, match=text):
            metric(rendered, truth)


def kornia_ssim(rendered: torch.Tensor, truth: torch.Tensor, peak: float = 1.0) -> float:
    first, second = (image.double().permute(2, 0, 1)[None] for image in (rendered, truth))
    return ssim_map(first, second, window_size=11, max_val=peak, eps=0.0, padding="valid").mean().item()


@pytest.mark.parametrize(("height", "width", "channels"), [(11, 700, 3), (300, 11, 1), (43, 61, 70), (130, 180, 3)])
def test_ssim_equals_kornia(height: int, width: int, channels: int) -> None:
    """More windows than one block has, more rows than one band, images next to equal, flat, bright, and not images."""
    rendered, truth = pair(height, width, channels, seed=width)
    flat, wild = torch.full_like(truth, 0.7), 1e3 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1))
    images = [
        (rendered, truth, 1.0),
        (rendered.float(), truth.float(), 1.0),
        (flat, flat + 1e-7, 1.0),
        (flat, truth, 1.0),
        (torch.ones_like(truth), torch.ones_like(truth) - 1e-3 * truth, 1.0),
        (1.0 - truth, truth, 1.0),
        (50 * rendered, 50 * truth, 50.0),
        (wild.double(), truth, 1.0),
    ]
    for first, second, peak in images:
        expected = kornia_ssim(first, second, peak)
        found = ssim(first, second, peak)
        assert found == pytest.approx(expected, abs=1e-10), (first.flatten()[0], peak)
        with limit_threads(1):
            assert ssim(first, second, peak) == found, "any number of threads gives the same bits"
    border = (0, 0, 5, 5, 5, 5)
    first, second = (image.clamp(0, 1) for image in (rendered, truth))
    expected = kornia_ssim(*(torch.nn.functional.pad(image, border) for image in (first, second)))
    assert ssim_3dgs(first, second) == pytest.approx(expected, abs=1e-10)
    turned = [image.transpose(0, 1).contiguous().transpose(0, 1) for image in (rendered, truth)]
    assert ssim(*turned) == ssim(rendered, truth), "strided tensors are read right"


def test_non_finite_values_are_an_error_not_a_number() -> None:
    truth = torch.zeros(12, 12, 3)
    rendered = truth.clone()
    rendered[3, 4, 1] = float("nan")
    for metric in (psnr, ssim):
        with pytest.raises(NonFiniteError, match="rendered image: 1 of 432"):
            metric(rendered, truth)
        with pytest.raises(NonFiniteError, match="truth"):
            metric(truth, rendered)


def test_infinite_values_survive_strict_json() -> None:
    for value in (math.inf, 31.25):
        text = json.dumps(metric_to_json("psnr", value), allow_nan=False)
        assert metric_from_json(json.loads(text), "psnr") == value
    assert metric_to_json("psnr", math.inf) == {"psnr": None, "psnr_infinite": True}
    for record in ({"psnr": None}, {}, {"psnr": True}, {"psnr": "12"}):
        assert metric_from_json(record, "psnr") is None


@pytest.mark.parametrize("channels", [1, 3, 4, 31])
def test_any_number_of_channels_is_the_mean_over_them(channels: int) -> None:
    rendered, truth = pair(17, 23, channels)
    expected = plain_ssim(rendered.numpy(), truth.numpy(), SSIM_WINDOW)
    assert 0.05 < expected < 0.95 and ssim(rendered, truth) == pytest.approx(expected, abs=1e-12)
    assert ssim(rendered.float(), truth.float()) == pytest.approx(expected, abs=1e-6)
    alone = [(rendered[..., i : i + 1], truth[..., i : i + 1]) for i in range(channels)]
    assert ssim(rendered, truth) == pytest.approx(np.mean([ssim(a, b) for a, b in alone]), abs=1e-12)
    errors = [10 ** (-psnr(a, b) / 10) for a, b in alone]
    assert psnr(rendered, truth) == pytest.approx(-10 * math.log10(float(np.mean(errors))), abs=1e-9)


def test_psnr_after_the_best_gain() -> None:
    generator = torch.Generator().manual_seed(2)
    truth = torch.rand(20, 30, 3, generator=generator, dtype=torch.float64)
    gain = torch.tensor([0.8, 1.1, 1.3], dtype=torch.float64)
    noise = 0.01 * torch.randn(20, 30, 3, generator=generator, dtype=torch.float64)
    assert psnr_gain((truth + noise) / gain, truth) == pytest.approx(psnr(truth + noise, truth), abs=0.1)
    assert psnr((truth + noise) / gain, truth) < 20
    found = psnr_gain(truth / gain + noise, truth)
    for factor in (0.999, 1.001):
        assert psnr((truth / gain + noise) * gain * factor, truth) <= found, "no other gain is better"
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[:, :5] = True
    spoiled = truth / gain
    spoiled[:, 5:] = 0.0
    assert psnr_gain(spoiled, truth, mask) > 200
    assert psnr_gain(torch.zeros_like(truth), truth) == pytest.approx(psnr(torch.zeros_like(truth), truth)), (
        "black has no gain"
    )


def metrics(values: list[float], bad: list[str]) -> dict[str, Any]:
    views = [{"name": f"v{i}", **metric_to_json("psnr", value)} for i, value in enumerate(values)]
    worst = min(range(len(values)), key=lambda i: values[i])
    return {
        "per_view": views,
        "ssim": 0.97654,
        **metric_to_json("psnr_worst", values[worst]),
        "view_worst": f"v{worst}",
        "worse_than_black_image": bad,
    }


def test_the_mean_and_views_worse_than_black_are_named() -> None:
    found = metrics([40.0, 20.0, math.inf], ["v1"])
    assert format_metrics(found) == "PSNR 30.00 dB, SSIM 0.977 (3 held-out views, 1 exact)"
    assert format_failed_views(found) == "1 of 3 held-out views are worse than a black image: v1"
    assert format_metrics(metrics([40.0], [])) == "PSNR 40.00 dB, SSIM 0.977 (1 held-out view)"
    assert format_metrics(metrics([math.inf], [])) == "PSNR inf dB, SSIM 0.977 (1 held-out view, 1 exact)"
    assert format_failed_views(metrics([40.0], [])) == ""
    assert format_failed_views(metrics([1.0] * 9, [f"v{i}" for i in range(9)])).endswith(
        "9 of 9 held-out views are worse than a black image: v0, v1, v2, v3, v4, v5 and 3 more"
    )
