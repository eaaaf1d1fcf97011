"""A picture of the top of a run's report, or of another page, for docs/getting_started.md and docs/launching.md. Needs
Chromium or Chrome on the PATH and the package playwright.

python docs/make_report_picture.py RUN_DIR docs/pictures/report.png [HEIGHT]
python docs/make_report_picture.py SWEEP_DIR/sweep.html docs/pictures/sweep.png [HEIGHT]
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WIDTH = 1240
WAIT = 8000  # milliseconds in which the interactive model is drawn


def main(run: Path, target: Path, height: int = 1180) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"needs one of {', '.join(BROWSERS)} on the PATH")
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=browser, args=list(FLAGS))
        page = opened.new_page(viewport={"width": WIDTH, "height": height})
        page.goto((run if run.is_file() else run / "report.html").resolve().as_uri())
        if page.query_selector("iframe") is not None:
            page.wait_for_timeout(WAIT)
        shot = page.screenshot()
        opened.close()
    with Image.open(io.BytesIO(shot)) as image:
        small = image.convert("RGB").resize((WIDTH * 3 // 4, height * 3 // 4), Image.Resampling.LANCZOS)
    small.quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
