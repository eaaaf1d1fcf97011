"""The pictures of the density in docs/viewer.md, from a run of ``scene=vdb`` or a built-in volume scene.

    python docs/make_inspection_pictures.py RUN_DIR [AGAINST] [TIME]

AGAINST is a folder of OpenVDB files, or "scene" (the default) for what the run's own scene was made from. Pictures are
stored with 6 bits per channel.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from neuprim.runs.inspect import InspectRequest, inspect_run

FOLDER = Path(__file__).parent / "pictures"
PICTURES = {
    "slices": (["slices"], True, (960, 440)),
    "primitives": (["primitives", "primitive"], False, (960, 440)),
}
"""Name of the picture -> views, whether beside the truth, size."""


def reduce(path: Path) -> None:
    """Stores a picture with 6 bits per channel, in half the bytes; palettes spoil the scalar bars."""
    Image.open(path).convert("RGB").point(lambda v: (v + 2) // 4 * 4 if v < 252 else v).save(path, optimize=True)


def main(run: Path, against: str = "scene", time: str = "0.62") -> None:
    for name, (show, beside, size) in PICTURES.items():
        out = FOLDER / f"inspect_{name}.png"
        inspect_run(
            InspectRequest(
                run, show, {"time": time}, against=against if beside else None, out=out, size=size, overwrite=True
            )
        )
        reduce(out)


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *sys.argv[2:])
