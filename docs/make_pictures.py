"""Pictures of README and site from finished runs: held-out views, truth above, render below.

    neuprim run task=static scene=solids --out RUN_DIR
    python docs/make_pictures.py RUN_DIR docs/pictures/solids.png 4 256
    python docs/make_pictures.py RUN_DIR docs/pictures/smoke_fire.png 6 192

    python benchmarks/quality.py DIR/pt_bunny --seconds 120
    python docs/make_pictures.py outputs/quality/pt_bunny-120s-0 docs/pictures/relight.png 5 240

Arguments: RUN_DIR TARGET [VIEWS] [SIDE].
VIEWS pictures of the run (4), each SIDE pixels wide (as rendered). A run with films shows its first held-out camera
over time.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageDraw


def columns_of(run: Path, views: int) -> list[list[Image.Image]]:
    """(truth, render) pairs: frames of the first film, evenly spaced from a tenth of it on, or held-out views."""
    films = sorted((run / "renders").glob("clip_*.webp"))
    if films:
        with Image.open(films[0]) as film:
            count, half = getattr(film, "n_frames", 1), film.width // 2
            columns = []
            for i in range(views):
                film.seek(round((0.1 + 0.9 * i / max(views - 1, 1)) * (count - 1)))
                frame = film.convert("RGB")
                columns.append([frame.crop((0, 0, half, frame.height)), frame.crop((half, 0, 2 * half, frame.height))])
            return columns
    truths = sorted((run / "renders").glob("test_*_truth.png"))
    picks = [truths[round(i * (len(truths) - 1) / max(views - 1, 1))] for i in range(min(views, len(truths)))]
    return [
        [Image.open(p).convert("RGB"), Image.open(p.with_name(p.name.replace("_truth", ""))).convert("RGB")]
        for p in picks
    ]


def main(run: Path, target: Path, views: int = 4, side: int | None = None) -> None:
    columns = columns_of(run, views)
    if side:
        columns = [
            [im.resize((side, side * im.height // im.width), Image.Resampling.BICUBIC) for im in pair]
            for pair in columns
        ]
    w, h = columns[0][0].size
    label = 18
    sheet = Image.new("RGB", (len(columns) * w, 2 * (h + label)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, text in enumerate(("ground truth (held out)", "neuprim")):
        draw.text((6, row * (h + label) + 3), text, fill="black")
        for column, pair in enumerate(columns):
            sheet.paste(pair[row], (column * w, row * (h + label) + label))
    target.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(target, optimize=True)


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 5:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
