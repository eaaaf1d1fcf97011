"""Measures of relit images, their means, and FLIP where it is installed."""

from __future__ import annotations

import sys
import types
from typing import Any

import pytest
import torch

from neuprim.core.errors import DataError
from neuprim.core.metrics import mean_metrics, psnr
from neuprim.scenes import PIXEL_CLASSES
from neuprim.tasks import relight
from neuprim.tasks.relight import relight_pixel_class_errors, relight_pixel_class_shares, relight_scores


def images(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand((16, 16, 3), generator=generator), torch.rand((16, 16, 3), generator=generator)


def test_what_a_display_cannot_show_does_not_count() -> None:
    rendered, truth = images()
    plain = relight_scores(rendered, truth)
    bright, dark = rendered.clone(), rendered.clone()
    truth = truth.clone()
    truth[3, 4], bright[3, 4], dark[3, 4] = 20.0, 5.0, 1.0
    assert relight_scores(bright, truth) == relight_scores(dark, truth) != plain
    assert plain["psnr_linear_clamped"] == pytest.approx(psnr(*images()))
    assert relight_scores(truth, truth)["psnr_display"] == float("inf")


def test_classes_pool_by_their_pixels() -> None:
    rendered, truth = images()
    first, second = torch.zeros(16, 16, dtype=torch.uint8), torch.full((16, 16), 2, dtype=torch.uint8)
    first[:4], second[:2] = 2, 0
    entries = [
        relight_pixel_class_errors(rendered, truth, first),
        relight_pixel_class_errors(rendered + 0.1, truth, second),
    ]
    assert set(entries[0]) == {"mse_background", "pixels_background", "mse_cast_shadow", "pixels_cast_shadow"}
    pooled = mean_metrics(entries)
    squares = torch.cat(
        [(rendered - truth).square()[first == 2], ((rendered + 0.1).clamp(0, 1) - truth).square()[second == 2]]
    )  # one pool over both views
    assert pooled["psnr_pooled_cast_shadow"] == pytest.approx(-10 * torch.log10(squares.mean()).item(), abs=1e-4)
    assert pooled["pixels_cast_shadow"] == 64 + 224
    shares = relight_pixel_class_shares([first, second])
    assert shares == {"lit": 0.0, "cast_shadow": 100.0, "attached_shadow": 0.0, "highlight": 0.0}


def test_wrong_class_maps_are_refused() -> None:
    rendered, truth = images()
    with pytest.raises(DataError, match="pixel classes"):
        relight_pixel_class_errors(rendered, truth, torch.zeros(8, 16, dtype=torch.uint8))
    with pytest.raises(DataError, match="values up to 5"):
        relight_pixel_class_errors(rendered, truth, torch.full((16, 16), len(PIXEL_CLASSES), dtype=torch.uint8))


def test_flip_joins_the_scores_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def evaluate(reference: Any, test: Any, dynamic_range: str, **options: Any) -> tuple[None, float, dict[str, float]]:
        calls.append((reference, test, dynamic_range, options))
        return None, 0.25, {}

    monkeypatch.setitem(sys.modules, "flip_evaluator", types.SimpleNamespace(evaluate=evaluate, __spec__=None))
    monkeypatch.setattr(relight, "flip_available", lambda: True)
    rendered, truth = images()
    assert relight_scores(rendered, truth)["flip"] == 0.25
    reference, test, dynamic_range, options = calls[0]
    assert dynamic_range == "LDR" and options["applyMagma"] is False and reference.dtype == test.dtype == "float32"
    assert abs(reference.mean() - relight.linear_to_srgb(truth).numpy().mean()) < 1e-6
