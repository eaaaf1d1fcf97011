"""Build the sdist from a copy of the checkout and the wheel from the sdist, check what is in them, and print the
wheel's path.

    package.py DIR        DIR is made; it ends up with the sdist and the wheel

Needs Python with pip and setuptools. The copy holds what git tracks, or without git all but what builds and tests leave
behind: setuptools would take up files that an earlier list of sources names, and so hide that a fresh checkout lacks
them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEFTOVERS = (
    ".git",
    ".venv*",
    "build",
    "dist",
    "outputs",
    "multirun",
    "site",
    "*.egg-info",
    "__pycache__",
    "*.py[cod]",
    ".*_cache",
    ".hypothesis",
)
PACKAGE = "neuprim"


def files(folder: Path) -> set[str]:
    """Paths of all files below a folder, with slashes, relative to it."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def copy_checkout(target: Path) -> None:
    """The files of the checkout as somebody else would get them."""
    try:
        listed = (
            subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
            .stdout.decode()
            .split("\0")
        )
    except (OSError, subprocess.CalledProcessError):  # no git here, or no repository
        shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*LEFTOVERS))
        return
    for name in listed:
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def build_sdist(source: Path, target: Path) -> Path:
    """The sdist of a source tree, in ``target``; called as pip calls it."""
    code = f"import sys; from setuptools import build_meta; build_meta.build_sdist({str(target)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, stdout=subprocess.DEVNULL)
    (made,) = target.glob("*.tar.gz")
    return made


def build_wheel(sdist: Path, target: Path) -> Path:
    """The wheel of an sdist, in ``target``; no other package is asked for."""
    pip = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--disable-pip-version-check",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run([*pip, "-w", str(target), str(sdist)], cwd=target, check=True, stdout=subprocess.DEVNULL)
    (made,) = target.glob("*.whl")
    return made


def package(target: Path) -> Path:
    """Build both; returns the wheel.

    Raises:
        SystemExit: a file of the checkout is missing from the sdist, or one of the package from the wheel.
    """
    target.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "checkout"
        copy_checkout(copy)
        wanted = files(copy)
        sdist = build_sdist(copy, target)
    wheel = build_wheel(sdist, target)
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    with zipfile.ZipFile(wheel) as archive:
        installed = set(archive.namelist())
    missing = [f"{sdist.name} lacks {name}" for name in sorted(wanted - packed)]
    own = {name for name in wanted if name.startswith(f"{PACKAGE}/")}
    missing += [f"{wheel.name} lacks {name}" for name in sorted(own - installed)]
    foreign = {name for name in installed if not name.startswith((f"{PACKAGE}/", f"{PACKAGE}-"))}
    missing += [f"{wheel.name} holds {name}, which is not the package's" for name in sorted(foreign)]
    if missing:
        raise SystemExit("\n".join(missing))
    return wheel


if __name__ == "__main__":
    if len(sys.argv) != 2 or os.path.lexists(sys.argv[1]):
        raise SystemExit("package.py DIR: expected the name of a folder that does not exist yet")
    print(package(Path(sys.argv[1]).absolute()))
