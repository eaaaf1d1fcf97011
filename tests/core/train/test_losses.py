"""The fused photometric loss against kornia and autograd."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.data import View
from neuprim.core.task import Supervision
from neuprim.core.train.losses import photometric, photometric_reference, scale_anisotropy

pytestmark = pytest.mark.usefixtures("either_way")

FRAME = Supervision(View("v", Camera(torch.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 1)))
SIZES = [(11, 11), (12, 40), (64, 77), (11, 200), (45, 13)]


def pair(height: int, width: int, channels: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A textured image and a noisy render of it, float32. (Without texture SSIM divides by almost nothing, and float32
    by less.)"""
    g = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 9, height), torch.linspace(0, 7, width), indexing="ij")
    truth = 0.5 + 0.4 * torch.sin(x[..., None] + torch.arange(channels)) * torch.cos(y[..., None])
    truth = truth + 0.1 * torch.randn(truth.shape, generator=g)
    return (truth + 0.1 * torch.randn(truth.shape, generator=g)).contiguous(), truth.contiguous()


def value_and_grad(loss, rendered: Tensor, truth: Tensor) -> tuple[float, Tensor, dict[str, float]]:  # type: ignore[no-untyped-def]
    leaf = rendered.clone().requires_grad_()
    value, parts = loss(leaf, truth, FRAME)
    value.backward()
    assert leaf.grad is not None
    return value.item(), leaf.grad, {name: float(part) for name, part in parts.items()}


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
@pytest.mark.parametrize("channels", [1, 2, 3, 5, 31])
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_fused_equals_kornia(size: tuple[int, int], channels: int, weight: float) -> None:
    rendered, truth = pair(*size, channels)
    fused = value_and_grad(photometric({"ssim_weight": weight}), rendered, truth)
    exact = value_and_grad(lambda a, b, frame: photometric_reference(a, b, weight), rendered.double(), truth.double())
    assert fused[0] == pytest.approx(exact[0], abs=1e-6)
    assert fused[2] == pytest.approx(exact[2], abs=1e-6)
    assert (fused[1].double() - exact[1]).abs().max() <= 1e-5 * exact[1].abs().max()
    assert exact[0] > 0.05


@pytest.mark.parametrize("box", [(0, 0, 0, 0), (0, 1, 0, 1), (30, 31, 0, 40), (10, 34, 17, 39), (39, 40, 49, 50)])
def test_equal_parts_of_images_count_as_equal(box: tuple[int, int, int, int]) -> None:
    """Columns left out because both images show the same there: outside of a box, or everywhere."""
    other, truth = pair(40, 50, 3)
    top, bottom, left, right = box
    rendered = truth.clone()
    rendered[top:bottom, left:right] = other[top:bottom, left:right]
    fused = value_and_grad(photometric({"ssim_weight": 0.4}), rendered, truth)
    exact = value_and_grad(lambda a, b, frame: photometric_reference(a, b, 0.4), rendered.double(), truth.double())
    assert fused[0] == pytest.approx(exact[0], abs=1e-6) and fused[2] == pytest.approx(exact[2], abs=1e-6)
    assert (fused[1].double() - exact[1]).abs().max() <= max(1e-5 * float(exact[1].abs().max()), 1e-8)


def test_not_a_number_is_not_equal() -> None:
    truth = pair(24, 20, 3)[1]
    truth[5, 6, 1] = math.nan
    assert math.isnan(photometric({"ssim_weight": 0.4})(truth, truth.clone(), FRAME)[0].item())


def test_flat_images_stay_finite() -> None:
    value, grad, _ = value_and_grad(photometric({"ssim_weight": 0.2}), torch.zeros(16, 16, 3), torch.ones(16, 16, 3))
    assert math.isfinite(value) and bool(torch.isfinite(grad).all())
    assert value == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("size", [(10, 40), (40, 10), (1, 1)])
def test_small_images_use_l1_alone(size: tuple[int, int]) -> None:
    rendered, truth = pair(*size, 3)
    value, parts = photometric({"ssim_weight": 0.2})(rendered, truth, FRAME)
    assert value.item() == pytest.approx((rendered - truth).abs().mean().item())
    assert set(parts) == {"l1"}


def test_weight_zero_is_l1() -> None:
    rendered, truth = pair(20, 20, 3)
    value, grad, _ = value_and_grad(photometric({"ssim_weight": 0.0}), rendered, truth)
    assert value == pytest.approx((rendered - truth).abs().mean().item())
    assert torch.allclose(grad, (rendered - truth).sign() / rendered.numel())


def test_upstream_factor_reaches_the_gradient() -> None:
    rendered, truth = pair(15, 15, 3)
    _, once, _ = value_and_grad(photometric({"ssim_weight": 0.2}), rendered, truth)
    _, thrice, _ = value_and_grad(
        lambda a, b, frame: tuple(
            x if i else x * 3 for i, x in enumerate(photometric({"ssim_weight": 0.2})(a, b, frame))
        ),
        rendered,
        truth,
    )
    assert torch.allclose(thrice, 3 * once)


def test_strided_images_are_read_right() -> None:
    rendered, truth = pair(24, 20, 3)
    loss = photometric({"ssim_weight": 0.2})
    strided = rendered.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    assert not strided.is_contiguous()
    assert loss(strided, truth, FRAME)[0].item() == loss(rendered, truth, FRAME)[0].item()


def test_spheres_have_no_anisotropy() -> None:
    spheres = torch.tensor([[0.1] * 3, [-4.0] * 3, [50.0] * 3], requires_grad=True)
    value = scale_anisotropy(spheres)
    value.backward()
    assert value.item() == 0.0
    assert spheres.grad is not None and bool((spheres.grad == 0).all())


def test_anisotropy_is_the_spread_of_axes_over_the_shortest() -> None:
    axes = torch.tensor([[1.0, 2.0, 3.0], [5.0, 5.0, 10.0]])
    expected = (torch.tensor([1.0, 2.0, 3.0]).std() + torch.tensor([1.0, 1.0, 2.0]).std()) / 2
    assert scale_anisotropy(axes.log()).item() == pytest.approx(expected.item(), rel=1e-6)
    assert scale_anisotropy((axes * 1e-6).log()).item() == pytest.approx(expected.item(), rel=1e-5)
