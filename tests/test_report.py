"""The report of finished, interrupted and damaged runs: content, escaping, and that the page stands alone."""

from __future__ import annotations

import html.parser
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.errors import ConfigError, DataError, NonFiniteError
from neuprim.core.metrics import psnr, ssim, to_json
from neuprim.report import ERROR_SCALE, error_map, write_report
from neuprim.report.curves import curve, dots
from neuprim.report.pictures import inline
from neuprim.report.record import read_run
from neuprim.report.text import byte_size, count, decimal, duration, escape

NAMES = ("r_0", "r_25", "night-view", "r_75")


def scene(height: int, width: int, turn: float) -> torch.Tensor:
    """A shaded ball over a chequered floor, turned a little for every view; float64 sRGB."""
    y, x = np.mgrid[:height, :width]
    u, v = (x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1
    v = v * height / width
    floor = ((np.floor(6 * u / (v + 1.3) + turn) + np.floor(6 / (v + 1.3))) % 2)[..., None] * np.array([0.25, 0.27, 0.3]) + 0.5
    sky = np.stack([0.62 + 0.2 * v, 0.74 + 0.12 * v, 0.9 + 0 * v], -1)
    image = np.where((v > 0.05)[..., None], floor, sky)
    radius = (u - 0.25 * math.sin(turn)) ** 2 + (v + 0.05) ** 2
    normal = np.stack([u - 0.25 * math.sin(turn), v + 0.05, np.sqrt(np.clip(0.2 - radius, 0, None))], -1) / math.sqrt(0.2)
    light = np.clip(normal @ np.array([-0.5, -0.6, 0.62]), 0, 1)[..., None]
    ball = np.array([0.75, 0.22, 0.12]) * (0.2 + 0.8 * light) + 0.6 * light**24
    return torch.from_numpy(np.clip(np.where((radius < 0.2)[..., None], ball, image), 0, 1))


def blurred(image: torch.Tensor, seed: int) -> torch.Tensor:
    """What an imperfect model might render: soft edges, a little noise."""
    rows = image.permute(2, 0, 1)[None]
    soft = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(rows, (2, 2, 2, 2), "replicate"), 5, 1)[0].permute(1, 2, 0)
    noise = np.random.default_rng(seed).standard_normal(image.shape) * (0.006 + 0.008 * seed)
    return (soft + torch.from_numpy(noise)).clamp(0, 1)


def save(path: Path, image: Any) -> None:
    pixels = image if isinstance(image, np.ndarray) else (image * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(path)


def make_log(lines: int, held_out_every: int) -> list[dict[str, float]]:
    rng = np.random.default_rng(5)
    log = []
    for i in range(lines):
        step = (i + 1) * 10
        progress = 1 - math.exp(-step / 900)
        line = {
            "step": step,
            "seconds": 0.085 * step + 0.00002 * step**2,
            "loss": 0.31 * math.exp(-4.2 * progress) * math.exp(0.15 * rng.standard_normal()),
            "psnr": 12 + 19 * progress + 0.9 * rng.standard_normal(),
            "primitives": int(1000 + 9000 * min(1, max(0, step - 500) / 3000)),
        }
        if (i + 1) % held_out_every == 0:
            line["eval_psnr"] = 11.5 + 18 * progress
        log.append(line)
    return log


def make_run(folder: Path, size: tuple[int, int] = (48, 64), lines: int = 400, names: tuple[str, ...] = NAMES) -> Path:
    """A run directory as training leaves it, with pictures and numbers that belong together."""
    (folder / "renders").mkdir(parents=True)
    entries = []
    for i, name in enumerate(names):
        truth = scene(*size, turn=0.8 * i)
        rendered = blurred(truth, i)
        base = folder / "renders" / f"test_{i:03d}_{name}"
        save(Path(f"{base}.png"), rendered)
        save(Path(f"{base}_truth.png"), truth)
        save(Path(f"{base}_error.png"), error_map(rendered, truth))
        entries.append(
            {"name": name, **to_json("psnr", psnr(rendered, truth)), "ssim": ssim(rendered, truth), "seconds": 0.021 + 0.001 * i}
        )
    frames = [Image.fromarray((scene(*size, 0.5 * k).numpy() * 255).astype(np.uint8)) for k in range(6)]
    frames[0].save(folder / "renders" / "orbit.webp", save_all=True, append_images=frames[1:], duration=120, loop=0, quality=70)
    metrics: dict[str, Any] = {
        "task": "static", "scene": "chequered-ball", "split": "test", "data_source": "generated",
        "psnr": float(np.mean([e["psnr"] for e in entries])), "ssim": float(np.mean([e["ssim"] for e in entries])),
        "psnr_worst": min(e["psnr"] for e in entries), "per_view": entries,
        "primitives": 10_000, "parameters": 670_000, "parameters_per_primitive": 67, "model_bytes": 2_684_112,
        "iterations": 4000, "train_seconds": 664.2, "render_fps": 41.37, "backend": "cpu", "device": "16-core CPU",
        "checkpoint": "last", "downsampling": "200x200 from 800x800 by area", "background": [1.0, 1.0, 1.0], "seed": 0, "color_space": "srgb",
        "versions": {"neuprim": "0.1.0", "torch": "2.13.0+cpu", "python": "3.11.2", "numpy": "2.3.0"},
        "non_default": {"train.iterations": [30000, 4000], "scene.downsample": [1, 4], "model.growth": [None, {"until": 3000}], "train.ssim": [True, False]},
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in make_log(lines, 25)), encoding="utf-8")
    (folder / "config.yaml").write_text(
        "task: static\nscene:\n  name: chequered-ball\n  downsample: 4\npreset: fast\nmodel:\n  neurons: 8\n"
        "train:\n  iterations: 4000\n  ssim: false\nrenderer:\n  backend: cpu\nseed: 0\n",
        encoding="utf-8",
    )
    return folder


def change(run: Path, **entries: Any) -> None:
    """Set entries of metrics.json; ``...`` removes one."""
    path = run / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8")) | entries
    path.write_text(json.dumps({k: v for k, v in metrics.items() if v is not ...}), encoding="utf-8")
