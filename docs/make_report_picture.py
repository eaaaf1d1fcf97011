"""A picture of the top of a run's report, or of another page, for docs/getting_started.md and docs/launching.md. Needs
Chromium or Chrome on the PATH.

python docs/make_report_picture.py RUN_DIR docs/pictures/report.png [HEIGHT]
python docs/make_report_picture.py SWEEP_DIR/sweep.html docs/pictures/sweep.png [HEIGHT]
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTH = 1240


def main(run: Path, target: Path, height: int = 1500) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"needs one of {', '.join(BROWSERS)} on the PATH")
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={WIDTH},{height}"]
        address = (run if run.is_file() else run / "report.html").resolve().as_uri()
        subprocess.run(
            [browser, *flags, f"--user-data-dir={folder}/user", f"--screenshot={shot}", address],
            check=True,
            capture_output=True,
        )
        with Image.open(shot) as image:
            small = image.convert("RGB").resize((WIDTH * 3 // 4, height * 3 // 4), Image.Resampling.LANCZOS)
    small.quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
