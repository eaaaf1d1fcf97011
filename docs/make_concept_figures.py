"""The figures of docs/concepts.md: what a run is made of, one pixel, and the views of a scene.

python docs/make_concept_figures.py docs/pictures

Draws concept_run.svg, concept_pixel.svg and concept_views.svg. Weights and opacities of the pixel are computed.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, FancyBboxPatch, Polygon

INK, SOFT, WARM, COOL = "#37474f", "#b0bec5", "#ff7043", "#4f9bd9"
STYLE = {"font.size": 10, "svg.hashsalt": "neuprim", "text.color": INK, "axes.edgecolor": INK}


def blank(width: float, height: float) -> Axes:
    """Axes without ticks, in inches."""
    _, axes = plt.subplots(figsize=(width, height), layout="constrained")
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.axis("off")
    return axes


def box(axes: Axes, at: tuple[float, float], size: tuple[float, float], title: str, text: str, face: str) -> None:
    axes.add_patch(FancyBboxPatch(at, *size, boxstyle="round,pad=0,rounding_size=0.08", fc=face, ec=INK, lw=1))
    x, top = at[0] + size[0] / 2, at[1] + size[1]
    axes.text(x, top - 0.2, title, ha="center", va="center", weight="bold")
    axes.text(x, (at[1] + top - 0.3) / 2, text, ha="center", va="center", fontsize=8.5, linespacing=1.35)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2, "shrinkA": 0, "shrinkB": 0})


def draw_run() -> None:
    axes = blank(8.6, 2.6)
    parts = (("task", "what kind of model"), ("scene", "which data"), ("preset", "which settings"))
    for row, (title, text) in enumerate(parts):
        bottom = 1.8 - 0.85 * row
        box(axes, (0.05, bottom), (1.85, 0.68), title, text, "#eceff1")
        arrow(axes, (1.95, bottom + 0.34), (2.55, 1.29 + 0.25 * (1 - row)))
    box(axes, (2.6, 0.65), (1.6, 1.3), "run", "training and\nmeasurement", "#ffe0d3")
    arrow(axes, (4.25, 1.3), (4.8, 1.3))
    files = "config.yaml\nmodel.safetensors\ncheckpoint.safetensors\nmetrics.json\nreport.html, renders/"
    box(axes, (4.85, 0.3), (1.95, 2.0), "run directory", files, "#e1effa")
    arrow(axes, (6.85, 1.3), (7.3, 1.3))
    for row, name in enumerate(("view", "render", "eval", "inspect", "export", "prune", "compress")):
        axes.text(7.4, 2.2 - 0.3 * row, name, va="center", family="monospace", fontsize=9)


def draw_pixel() -> None:
    axes = blank(8.6, 2.9)
    eye, slope = np.array([0.35, 1.1]), math.tan(math.radians(4.0))
    axes.add_patch(Polygon(eye + np.array([(0, 0), (0.42, 0.3), (0.42, -0.24)]), fc="white", ec=INK, lw=1.2))
    axes.text(eye[0] + 0.2, 0.55, "camera", ha="center")
    axes.plot([eye[0], 8.3], [eye[1], eye[1] + 7.95 * slope], color=INK, lw=1, ls="--")
    axes.text(8.3, eye[1] + 7.95 * slope + 0.12, "ray of one pixel", ha="right", va="bottom")
    solids = ((2.6, 1.35, 0.75, 0.42, 20, "#ffcc80", 0.9), (4.3, 1.2, 0.6, 0.5, -25, "#a5d6a7", 0.6))
    solids = (*solids, (6.1, 1.62, 0.9, 0.45, 10, "#90caf9", 1.5))
    left = 1.0
    for number, (x, y, a, b, degrees, face, density) in enumerate(solids, start=1):
        axes.add_patch(Ellipse((x, y), 2 * a, 2 * b, angle=degrees, fc=face, ec=INK, lw=1, alpha=0.85))
        turn = math.radians(degrees)
        R = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        p, v = R @ (eye - (x, y)) / (a, b), R @ np.array([1, slope]) / (a, b)
        middle = -(p @ v) / (v @ v)
        half = math.sqrt((1 - np.sum((p + middle * v) ** 2)) / (v @ v))
        ends = np.array([middle - half, middle + half])
        axes.plot(eye[0] + ends, eye[1] + ends * slope, color=WARM, lw=4, solid_capstyle="butt")
        alpha = 1 - math.exp(-density * 2 * half * math.hypot(1, slope))
        weight, left = left * alpha, left * (1 - alpha)
        axes.text(x, 0.42, f"sample {number}", ha="center", color="#d84315")
        axes.text(x, 0.14, f"opacity {alpha:.2f}, weight {weight:.2f}", ha="center", fontsize=8.5)
    axes.annotate("primitive", (2.35, 1.72), (1.6, 2.5), arrowprops={"arrowstyle": "-", "color": INK})
    axes.text(7.75, 0.42, "background", ha="center")
    axes.text(7.75, 0.14, f"weight {left:.2f}", ha="center", fontsize=8.5)


def draw_views() -> None:
    axes = blank(8.6, 2.9)
    middle = np.array([1.7, 1.35])
    axes.add_patch(Ellipse(middle, 0.8, 0.62, fc="#ffcc80", ec=INK, lw=1))
    axes.text(*middle, "scene", ha="center", va="center")
    for number in range(10):
        turn = 2 * math.pi * (number + 0.5) / 10
        out, side = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        eye = middle + out * (1.3, 1.12)
        held_out = number % 5 == 1
        corners = [eye, eye - 0.26 * out + 0.14 * side, eye - 0.26 * out - 0.14 * side]
        axes.add_patch(Polygon(corners, fc="white" if held_out else COOL, ec=INK, lw=1.2))
    for row, (face, text) in enumerate(((COOL, "training view"), ("white", "held-out view"))):
        axes.add_patch(
            Polygon([(3.3, 2.5 - row * 0.35), (3.55, 2.6 - row * 0.35), (3.55, 2.4 - row * 0.35)], fc=face, ec=INK)
        )
        axes.text(3.65, 2.5 - row * 0.35, text, va="center")
    across, down, cell = 5.85, 2.0, 0.5
    axes.text(across + 2 * cell, down + 0.42, "frames (time 0 to 1)", ha="center")
    axes.text(across - 0.12, down - 1.5 * cell, "cameras", ha="right", va="center")
    for row in range(4):
        for column in range(4):
            face = "white" if row == 2 else COOL
            at = (across + column * cell, down - (row + 1) * cell + 0.12)
            axes.add_patch(FancyBboxPatch(at, 0.42, 0.38, boxstyle="round,pad=0,rounding_size=0.05", fc=face, ec=INK))
    axes.text(across + 2 * cell, down - 4 * cell - 0.15, "each cell is one view", ha="center", fontsize=8.5)


FIGURES = {"concept_run.svg": draw_run, "concept_pixel.svg": draw_pixel, "concept_views.svg": draw_views}

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    plt.rcParams.update(STYLE)
    for name, draw in FIGURES.items():
        draw()
        plt.savefig(Path(sys.argv[1]) / name, metadata={"Date": None, "Creator": None})
        plt.close()
