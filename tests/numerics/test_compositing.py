"""The rules of compositing, against a slow loop written from the method alone: one pixel, one primitive at a time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.backends import REFERENCE
from tests import scenes
from tests.backends import BACKENDS, by

BACKGROUND = (0.3, 0.1, 0.8)


def rotation(q: np.ndarray) -> np.ndarray:
    """wxyz quaternion -> matrix, by rotating the axes: v + 2w (u x v) + 2 u x (u x v)."""
    q = q / np.linalg.norm(q)
    u = q[1:]
    columns = [e + 2 * q[0] * np.cross(u, e) + 2 * np.cross(u, np.cross(u, e)) for e in np.eye(3)]
    return np.stack(columns, 1)


def loop(t: dict[str, Tensor], camera: Camera, s: RenderSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rgb, alpha, depth) in float64, from method.md."""
    v = {k: x.double().numpy() for k, x in t.items()}
    view = camera.viewmat.numpy()
    R, eye = view[:3, :3], camera.position.numpy()
    centre_depth = v["means"] @ R[2] + view[2, 3]
    order = np.argsort(centre_depth, kind="stable")
    C = v["colors"].shape[1]
    rgb = np.zeros((camera.height, camera.width, C))
    alpha_image = np.zeros((camera.height, camera.width))
    depth = np.zeros((camera.height, camera.width))
    for y in range(camera.height):
        for x in range(camera.width):
            in_camera = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0])
            in_camera /= np.linalg.norm(in_camera)
            d = R.T @ in_camera
            T, colour, z_sum = 1.0, np.zeros(C), 0.0
            for i in order:
                scales = np.exp(v["log_scales"][i])
                m = scales.max()
                whiten = np.diag(1 / scales) @ rotation(v["quats"][i]).T
                p, w = whiten @ (eye - v["means"][i]), whiten @ d
                a = w @ w
                t_mid = -(p @ w) / a
                closest = p + t_mid * w
                D = 1 - closest @ closest
                if D <= 0:
                    continue
                h = math.sqrt(D / a)
                t0, t1 = max(t_mid - h, s.near / in_camera[2]), t_mid + h
                if t1 <= t0:
                    continue
                mid, h = (t0 + t1) / 2, (t1 - t0) / 2
                local = (eye + mid * d - v["means"][i]) / m
                total = v["b2"][i, 0]
                for k in range(v["W1"].shape[1]):
                    rate, phase = 30 * (v["W1"][i, k] @ d) / m, 30 * (v["W1"][i, k] @ local + v["b1"][i, k])
                    total += v["w2"][i, k] * math.cos(phase) * np.sinc(rate * h / math.pi)
                integral = max(2 * h / m * total, 0.0)
                alpha = min(s.alpha_max, 1 - math.exp(-integral))
                if integral <= 0 or alpha < s.alpha_min:
                    continue
                colour += v["colors"][i] * alpha * T
                z_sum += alpha * T * mid * in_camera[2]
                T *= 1 - alpha
                if T < s.transmittance_min:
                    break  # composited, then stopped
            rgb[y, x] = colour + T * np.array(BACKGROUND[:C])
            alpha_image[y, x] = 1 - T
            depth[y, x] = z_sum / (1 - T) if T < 1 else 0.0
    return rgb, alpha_image, depth


CASES = {
    "default": (RenderSettings(), 3.0, 0.0),
    "camera inside": (RenderSettings(near=0.05), 0.3, 0.0),
    "clamped": (RenderSettings(alpha_max=0.3), 3.0, 1.0),
    "faint pairs skipped": (RenderSettings(alpha_min=0.2), 3.0, 0.0),
    "stopped early": (RenderSettings(transmittance_min=0.3), 3.0, 1.0),
    "near plane": (RenderSettings(near=3.0), 3.0, 0.0),
}


@pytest.mark.parametrize("name", CASES)
def test_against_the_loop(name: str) -> None:
    settings, distance, extra = CASES[name]
    t = scenes.tensors(25, seed=21, radius=0.35)
    t["b2"] += extra
    camera = scenes.camera(14, 10, distance=distance, fov=45 if distance > 1 else 90, shift=(0.8, 0.4))
    settings = replace(settings, depth=True)
    expected = loop(t, camera, settings)
    assert expected[1].max() > 0.3
    for backend in BACKENDS:
        bound = 1e-11 if backend == REFERENCE else 1e-5
        dtype = torch.float64 if backend == "reference" else torch.float32
        model = {k: v.to(dtype) for k, v in t.items()}
        out = render_lowered(
            scenes.lowered(model), camera, replace(settings, **by(backend)), torch.tensor(BACKGROUND, dtype=dtype)
        )
        assert out.depth is not None
        for image, found in zip(expected, (out.rgb, out.alpha, out.depth), strict=True):
            scale = max(np.abs(image).max(), 1.0)
            assert np.abs(found.double().numpy() - image).max() <= bound * scale * (
                10 if image is expected[2] else 1
            ), backend


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_primitive_that_crosses_the_limit_still_counts(backend: str) -> None:
    """Three opaque spheres in a row, T_min = 0.05: the second takes T from 0.1 to 0.01 and is drawn, the third is
    not."""
    t = scenes.tensors(3)
    t["w2"] *= 0
    t["quats"][:] = torch.tensor([1.0, 0, 0, 0])
    t["log_scales"][:] = math.log(0.2)
    t["b2"][:] = 50.0
    axis = scenes.camera().position.float() / 3
    t["means"] = torch.tensor([1.0, 0.0, -1.0])[:, None] * axis
    t["colors"] = torch.eye(3)
    camera = scenes.camera(17, 17)
    settings = RenderSettings(**by(backend), alpha_max=0.9, transmittance_min=0.05)
    out = render_lowered(scenes.lowered(t), camera, settings, torch.ones(3))
    assert out.rgb[8, 8].tolist() == pytest.approx([0.9 + 0.01, 0.09 + 0.01, 0.01], abs=1e-6)
    assert out.alpha[8, 8].item() == pytest.approx(0.99, abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_clamped_pair_has_no_gradient_in_its_density(backend: str) -> None:
    t = scenes.tensors(1)
    t["means"], t["w2"] = t["means"] * 0, t["w2"] * 0
    t["b2"][:] = 50.0
    t = {k: v.clone().requires_grad_() for k, v in t.items()}
    camera = scenes.camera(3, 3, fov=1.0)
    out = render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend)))
    assert torch.allclose(out.alpha, torch.tensor(0.99))
    out.rgb.sum().backward()
    assert t["b2"].grad is not None and t["b2"].grad.abs().max() == 0
    assert t["colors"].grad is not None and torch.allclose(t["colors"].grad, torch.tensor(9 * 0.99))
