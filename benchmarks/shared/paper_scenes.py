"""Two scenes that nobody trained here: what the cost model says that they would take, and what runs out first.

Amounts follow from the scene alone; seconds here are the fitted coefficients'; seconds on a card are computed from what
was recorded on it, and were not measured.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.tables import Table

__all__ = ["CITY", "SEQUENCE", "Paper", "amounts", "table_of_scenes"]

CARD = Path(__file__).parents[1] / "results" / "gpu" / "nvidia_h100_80gb_hbm3.json"
BANDWIDTH = 3.35e12
"""Bytes a second of the card's memory, by its data sheet."""
TRAFFIC = 28
"""Bytes that Adam reads and writes for a number: itself and two moments, both ways, and its gradient."""
TILE = 16


@dataclass(frozen=True)
class Paper:
    """A scene as a user would plan it.

    Attributes:
        primitives, numbers: how many, and of how many numbers each.
        shown: share of them that a view shows. overlap: ellipsoids over a pixel.
        pixels: of a view. views: different ones. seen: how often each is looked at.
        frames, voxels, cameras: of a volume's ground truth; 0 for photographs.
    """

    title: str
    primitives: int
    numbers: int
    shown: float
    overlap: float
    pixels: int
    views: int
    seen: int
    frames: int = 0
    voxels: int = 0
    cameras: int = 0


SEQUENCE = Paper("10,000 frames at 512³", 2_000_000, 23, 0.005, 60, 512**2, 100_000, 3, 10_000, 512, 12)
CITY = Paper("a city: 5,000 photographs of 12 Mpx", 20_000_000, 70, 0.05, 60, 12_000_000, 5000, 30)


def amounts(scene: Paper) -> dict[str, float]:
    """Bytes and counts that no machine changes."""
    P, N, drawn = scene.numbers, scene.primitives, scene.shown * scene.primitives
    across = math.sqrt(scene.overlap * scene.pixels / drawn)  # pixels, of a square as large as an ellipsoid on screen
    return {
        "drawn": drawn,
        "state": N * (16.0 * P + 8),
        "rows": 8.0 * P * drawn,
        "buffer": 16.0 * N * (P + 2),
        "pairs": drawn * (across / TILE + 1) ** 2,
        "whole sends": 8.0 * N * (P + 2),
        "parts send": drawn * (8.0 * P + 8),
        "steps": float(scene.views * scene.seen),
    }


def seconds_here(scene: Paper, model: dict[str, Any], ranks: int, parts: bool) -> dict[str, float]:
    """Terms of a step of one view a rank, on one thread each."""
    a, view = amounts(scene), model["step"]
    alive = (
        a["drawn"] if scene.frames else scene.primitives
    )  # of a sequence, others are left out before anything is computed
    in_view = a["drawn"] if parts else alive
    numbers = scene.primitives * scene.numbers / (ranks if parts else 1)
    sent = (a["parts send"] if parts else a["whole sends"]) * (ranks - 1) / ranks
    return {
        "primitives": view["a primitive"] * in_view + view["a number of a primitive"] * in_view * scene.numbers,
        "tiles": view["a tile's entry"] * a["pairs"],
        "pixels": view["a pixel"] * scene.pixels,
        "hits": view["an ellipsoid over a pixel"] * scene.overlap * scene.pixels,
        "Adam": model["adam"]["a number"] * numbers,
        "who is in sight": model["sight"]["a primitive"] * alive if parts else 0.0,
        "sending": model["exchange"]["a byte"] * sent,
    }


def seconds_on_card(scene: Paper, ranks: int, parts: bool) -> tuple[float, float]:
    """(seconds of a step on a card without what is sent, bytes that drawing takes), from the recorded times of the form
    K = 2, p = 2."""
    card = json.loads(CARD.read_text())
    row = max((r for r in card["times"] if r["form"] == "K=2 p=2"), key=lambda r: r["primitives"])
    hits = scene.overlap * scene.pixels
    numbers = scene.primitives * scene.numbers / (ranks if parts else 1)
    drawing = 1e-3 * row["both_ms"] * max(hits / row["slots"], amounts(scene)["pairs"] / row["pairs"])
    return drawing + numbers * TRAFFIC / BANDWIDTH, 1e6 * row["peak_mb"] * hits / row["slots"]


def _size(count: float) -> str:
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count / 1e3:.3g} kB"


def _ways(scene: Paper, model: dict[str, Any]) -> Table:
    rows = Table(
        "ranks", "primitives", "state of a rank", "and buffers, rows", "a rank sends a step", "step of a view a rank here", "most of it", "core-hours here",
        "H100, computed, without sending: step", "hours",
    )  # fmt: skip
    a = amounts(scene)
    for ranks, parts in ((1, False), (8, False), (8, True), (64, True)):
        state = a["state"] / (ranks if parts else 1)
        extra = a["rows"] if parts else (a["buffer"] if ranks > 1 else 0.0)
        sent = (a["parts send"] if parts else a["whole sends"]) * (ranks - 1) / ranks
        terms = seconds_here(scene, model, ranks, parts)
        step, largest = sum(terms.values()), max(terms, key=lambda name: terms[name])
        card, _ = seconds_on_card(scene, ranks, parts)
        rows.row(
            ranks, "in parts" if parts else "all on each", _size(state), _size(extra) if extra else "", _size(sent) if sent else "", f"{step:.2g} s",
            f"{largest}, {100 * terms[largest] / step:.0f} %", f"{a['steps'] * step / 3600:,.0f}", f"{1e3 * card:.0f} ms",
            f"{a['steps'] / ranks * card / 3600:.2g}",
        )  # fmt: skip
    return rows


def _truth(scene: Paper, model: dict[str, Any]) -> str:
    rays = 4 * scene.pixels
    frame = sum(c * n for c, n in zip(model["frame"].values(), (1, scene.voxels**3, scene.voxels**4), strict=True))
    image = (
        model["image"]["an image"]
        + model["image"]["a ray"] * rays
        + model["image"]["a cell of a ray"] * rays * scene.voxels
    )
    hours = scene.frames * (frame + scene.cameras * image) / 3600
    light = model["frame"]["a cell on a voxel's way to the light"] * scene.voxels**4 * scene.frames / 3600
    return (
        f"Ground truth: {frame:.3g} s a frame and {image:.3g} s an image here, {hours:,.0f} core-hours for {scene.frames:,} frames and {scene.cameras} cameras; "
        f"a frame's medium takes {_size(33 * scene.voxels**3)} while it is prepared, whose box is full; images of half floats {_size(8 * scene.pixels * scene.views * 1.2)} "
        f"before they are compressed. {100 * light / hours:.0f} % of the hours are voxels' ways to the light, which grow with the fourth power of the resolution: frames are independent, "
        "so that workers share them, and this, not the training, is what such a sequence waits for."
    )


def _photographs(scene: Paper) -> str:
    whole = 4.0 * scene.primitives * scene.numbers
    return (
        f"Photographs of 8 bits take {_size(3.0 * scene.pixels * scene.views)}, of which a process keeps 2 GiB and reads the rest again; all parameters, which every rank makes at the start and the "
        f"first reads at the end, {_size(whole)}, {_size(8 * whole)} for eight ranks of one machine. Parts leave out what a view does not show and share Adam's numbers "
        "out; one term still grows with the whole scene, who is in sight: each rank asks that of its primitives for everybody's view. What is left grows with a view, which more ranks do not make smaller."
    )


def table_of_scenes(model: dict[str, Any]) -> str:
    """Both scenes, as a page shows them."""
    parts = []
    for scene in (SEQUENCE, CITY):
        a = amounts(scene)
        _, drawing = seconds_on_card(scene, 1, False)
        fits = (80e9 - drawing - a["rows"]) / (16 * scene.numbers + 8)
        print(scene.title)
        parts.append(
            f"**{scene.title[0].upper() + scene.title[1:]}**: {scene.primitives / 1e6:g} million primitives of {scene.numbers} numbers, {100 * scene.shown:g} % of them in a "
            f"view, {scene.overlap:g} over a pixel; {scene.views:,} views of {scene.pixels / 1e6:.3g} Mpx, each seen {scene.seen} times."
            + f" {_truth(scene, model) if scene.frames else _photographs(scene)}"
            + f"\n\n{_ways(scene, model)}\n\nOn a card, drawing such a view would take {_size(drawing)}; beside it a card of 80 GB has room for the state of "
            f"{max(fits, 0) / 1e6:,.0f} million primitives."
        )
    return "\n\n".join(parts)
