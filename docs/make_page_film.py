"""The moving picture of the README, taken from web pages of models while they are turned, played and lit.

    neuprim run task=static  scene=solids scene.size=256 model.primitives=5000 train.iterations=6000 --out SOLIDS
    neuprim run task=dynamic scene=smoke_fire --out SMOKE
    neuprim run task=relight scene=lit_solids model.primitives=5000 train.iterations=6000 --out LIT
    neuprim export SOLIDS --format html --out docs/pages/solids.html level=2 views=3          # and SMOKE, LIT
    python docs/make_page_film.py docs/pages/solids.html docs/pages/smoke_fire.html docs/pages/lit_solids.html
    docs/pictures/pages.webp

Arguments: PAGE … TARGET [--side 240] [--frames 60]. Every frame is the page's own canvas, drawn at twice the side in
headless Chromium; a page with a time plays it, one with a light leads it around, and all turn. Needs a Chromium and the
package playwright.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from neuprim.core.cameras import Camera, orbit

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.browsers import Tab, browser, open_tab

_ELEVATION, _AWAY = 0.45, 3.0  # radians; radii of the scene
_FOV = 40.0  # degrees
_SWING = 0.35  # of a turn, for pages in which more than the camera moves
_SECONDS = 5.0


def moments(page: dict[str, Any], side: int, count: int) -> Iterator[tuple[Camera, dict[str, Tensor]]]:
    """A camera and conditions per frame, which begin again where they end."""
    focal = 0.5 * side / math.tan(math.radians(_FOV) / 2)
    template = Camera(torch.eye(4, dtype=torch.float64), focal, focal, side / 2, side / 2, side, side)
    center, up = (torch.tensor(page[key], dtype=torch.float64) for key in ("center", "up"))
    place = (center, up, _AWAY * page["radius"], _ELEVATION)
    fine = 360
    around = orbit(template, *place, fine)
    conditions = {one["name"]: torch.tensor(one["value"], dtype=torch.float64) for one in page["conditions"]}
    for k in range(count):
        phase = k / count
        turned = phase if not conditions else 0.5 * _SWING * math.sin(2 * math.pi * phase)
        yield (
            around[round(turned * fine) % fine],
            {name: moved(name, value, phase) for name, value in conditions.items()},
        )


def moved(name: str, value: Tensor, phase: float) -> Tensor:
    """Time runs from 0 to 1; a light goes around the axis z."""
    if name == "time":
        return torch.tensor(phase, dtype=torch.float64)
    if name != "light":
        return value
    c, s = math.cos(2 * math.pi * phase), math.sin(2 * math.pi * phase)
    x, y, z = value.tolist()
    return torch.tensor([c * x - s * y, s * x + c * y, z], dtype=torch.float64)


def frames_of(tab: Tab, side: int, count: int) -> list[Image.Image]:
    page = tab.page.evaluate("page")
    shown = [Image.fromarray(tab.shown(camera, values)) for camera, values in moments(page, 2 * side, count)]
    return [image.resize((side, side), Image.Resampling.LANCZOS) for image in shown]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", type=Path, nargs="+", metavar="PAGE")
    parser.add_argument("target", type=Path)
    parser.add_argument("--side", type=int, default=240)
    parser.add_argument("--frames", type=int, default=60)
    args = parser.parse_args()
    columns = []
    with browser() as chromium:
        for path in args.pages:
            with open_tab(chromium, path) as tab:
                columns.append(frames_of(tab, args.side, args.frames))
    film = []
    for images in zip(*columns, strict=True):
        film.append(Image.new("RGB", (args.side * len(images), args.side)))
        for k, image in enumerate(images):
            film[-1].paste(image, (k * args.side, 0))
    film[0].save(
        args.target,
        save_all=True,
        append_images=film[1:],
        duration=round(1000 * _SECONDS / len(film)),
        loop=0,
        quality=60,
        method=6,
    )
    print(f"{args.target}: {len(film)} frames, {args.target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
