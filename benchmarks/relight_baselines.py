"""What images that need no model score on the test split of lit_solids: the table in docs/relighting.md.

    python benchmarks/relight_baselines.py [--record]

Draws the scene at its default settings on first use and says how long that took. --record writes the table to
docs/relighting.md.
"""

from __future__ import annotations

import argparse
import time

from shared.tables import ROOT, Table, between_markers

from neuprim.core.data.views import ImageViews
from neuprim.core.io.files import cache_directory
from neuprim.core.task import SceneContext
from neuprim.tasks.relight.data import bright, lighting_of
from neuprim.tasks.relight.judging import baselines
from neuprim.tasks.relight.lit import load
from neuprim.tasks.relight.lit.generate import LitSettings
from neuprim.tasks.relight.measure import CLASSES, class_shares

PAGE = ROOT / "docs" / "relighting.md"
NAMES = {
    "black": "black image",
    "no_cast_shadows": "perfect shading without cast shadows",
    "nearest_light_of_25": "nearest light of 25, same camera",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="write the table to docs/relighting.md")
    args = parser.parse_args()
    cache = cache_directory()
    there = (cache / f"lit_solids-{LitSettings().key()}").is_dir()
    start = time.perf_counter()
    dataset = load({}, SceneContext(seed=0, cache_dir=cache))
    pixel_classes = lighting_of(dataset).classes
    assert isinstance(dataset.train, ImageViews) and pixel_classes is not None
    print(
        f"{'read' if there else 'drawn'} in {time.perf_counter() - start:.1f} s; {bright(dataset.train, 'lit_solids'):.4f} is the exposure\n"
    )
    classes = CLASSES[1:]
    table = Table("test split of `lit_solids`", "PSNR linear", "PSNR display", *(c.replace("_", " ") for c in classes))
    for key, numbers in baselines(dataset).items():
        pooled = [f"psnr_pooled_{c}" for c in classes]
        table.row(NAMES[key], *(f"{numbers[k]:.1f}" for k in ("psnr_linear_clamped", "psnr_display", *pooled)))
    shares = class_shares([pixel_classes(i) for i in range(len(dataset.test))])
    table.row("share of the pixels that show matter", "", "", *(f"{shares[c]:.1f} %" for c in classes))
    if args.record:
        between_markers(PAGE, "relight-baselines", str(table))


if __name__ == "__main__":
    main()
