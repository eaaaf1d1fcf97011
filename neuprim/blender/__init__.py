"""The add-on for Blender, and the function that packs it as an extension: :func:`write_blender_addon`."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

from neuprim.core.io.files import checked_atomic_path
from neuprim.version import __version__

ADDON = Path(__file__).parent / "addon"


def write_blender_addon(file: Path) -> None:
    """Write the add-on as a .zip file, an extension for Blender >= 4.2.

    The add-on starts this Python, unless the user sets another in its preferences.

    Raises:
        DataError: the file cannot be written.
    """
    manifest = (ADDON / "blender_manifest.toml").read_text(encoding="utf-8")
    contents = {
        "blender_manifest.toml": manifest.replace("VERSION", __version__),
        "__init__.py": (ADDON / "addon.py").read_text(encoding="utf-8"),
        "job.py": (ADDON / "job.py").read_text(encoding="utf-8"),
        "installation.json": json.dumps({"python": sys.executable}),
    }
    with checked_atomic_path(file) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in contents.items():
            archive.writestr(name, text)
