"""The README's picture from a finished run: held-out views, truth above, render below.

python docs/make_pictures.py RUN_DIR docs/pictures/solids.png
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageDraw


def main(run: Path, target: Path, views: int = 4) -> None:
    truths = sorted((run / "renders").glob("test_*_truth.png"))
    picks = [truths[round(i * (len(truths) - 1) / max(views - 1, 1))] for i in range(min(views, len(truths)))]
    columns = [[Image.open(p), Image.open(p.with_name(p.name.replace("_truth", "")))] for p in picks]
    w, h = columns[0][0].size
    label = 18
    sheet = Image.new("RGB", (len(columns) * w, 2 * (h + label)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, text in enumerate(("ground truth (held out)", "neuprim")):
        draw.text((6, row * (h + label) + 3), text, fill="black")
        for column, pair in enumerate(columns):
            sheet.paste(pair[row].convert("RGB"), (column * w, row * (h + label) + label))
    target.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(target, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
