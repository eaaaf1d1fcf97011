"""Compare the results of this checkout with those of another commit, bit by bit.

``python tools/compare_bits.py COMMIT`` makes three short trainings (one per task, both sort orders, population control
on), a quantised model, a web page, a VDB sequence and a PLY file in both checkouts, on this machine with one thread,
and compares SHA-256 sums.
Sums differ between processors, so none is stored. Text that names a version, a duration or a path does not count.
``--make DIR`` makes the files of this checkout alone. It exits with status 1 when anything differs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

CHECKOUT = Path(__file__).resolve().parent.parent

RUNS = {
    "static": "scene=solids scene.size=64 model.primitives=600 train.iterations=400 renderer.sort=entry",
    "dynamic": "scene=smoke_fire scene.size=32 scene.cameras=8 scene.timesteps=8 scene.resolution=24 "
    "model.primitives=800 "
    "train.iterations=300",
    "relight": "scene=lit_solids scene.size=48 model.primitives=500 train.iterations=300",
}

EXPORTS = (
    ("compress", "static", "--level 3 --steps 20", "static.neuprim"),
    ("import", "static.neuprim", "", "quantised"),
    ("export", "quantised", "--format npz", "quantised.npz"),
    ("export", "static", "--format ply", "static.ply"),
    ("export", "static", "--format gaussian-ply", "static_gaussians.ply"),
    ("export", "static", "--format html", "static.html"),
    ("export", "dynamic", "--format html", "dynamic.html"),
    ("export", "relight", "--format html", "relight.html"),
    ("export", "dynamic", "--format vdb", "dynamic_vdb"),
)

VOLATILE = re.compile(
    rb'("train_seconds": )[-+.\de]+|(neuprim[": ]+)\d+\.\d+\.\d+|(output_dir[=: ]+)[^\s"\\]+'
    rb"|[\da-f]{8}(-[\da-f]{4}){3}-[\da-f]{12}"
    rb'|nonce[-=]"?[\da-f]{32}|^\s*//[^\n]*',
    re.MULTILINE,
)
"""What two runs of the same code may write differently: durations, versions, paths, the UUID of a VDB file, comments
of a page's scripts and the nonce that is their hash."""


def make(checkout: Path, folder: Path) -> None:
    """Write all results of ``checkout`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for task, overrides in RUNS.items():
        _run(checkout, folder, f"run task={task} {overrides} renderer.threads=1")
        next((folder / "outputs").glob(f"{task}-*")).rename(folder / task)
    for command, run, options, name in EXPORTS:
        _run(checkout, folder, f"{command} {run} {options} --out {name}")


def _run(checkout: Path, folder: Path, arguments: str) -> None:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {**os.environ, **threads, "PYTHONPATH": str(checkout)}
    print(f"{checkout.name}: neuprim {arguments}", file=sys.stderr)
    result = subprocess.run(
        [sys.executable, "-m", "neuprim", *arguments.split()],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    if result.returncode:
        sys.exit(f"{checkout}: neuprim {arguments} failed:\n{result.stderr[-2000:]}")


def _write_metadata(checkout: Path) -> None:
    """Give a checkout metadata of its own; without it, Python finds the entry points of the installed package."""
    command = [sys.executable, "-c", "from setuptools import setup; setup()", "-q", "egg_info"]
    subprocess.run(command, cwd=checkout, check=True, capture_output=True)


def sums(folder: Path) -> dict[str, str]:
    """Name -> SHA-256 of every tensor of the models, of the exported arrays, and of the exported files."""
    found = {}
    for task in RUNS:
        for name, tensor in load_file(folder / task / "model.safetensors").items():
            found[f"{task}: {name}"] = _sum(tensor.tobytes())
    for path in sorted(folder.glob("*")) + sorted((folder / "dynamic_vdb").rglob("*.vdb")):
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found |= {
                    f"{path.name}: {name}": _sum(arrays[name].tobytes())
                    for name in arrays
                    if arrays[name].dtype.kind != "U"
                }
        elif path.suffix in (".ply", ".html", ".vdb"):
            found[path.name] = _sum(VOLATILE.sub(b"", path.read_bytes()))
    return found


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", nargs="?", help="commit to compare with")
    parser.add_argument("--make", type=Path, metavar="DIR", help="make the files of this checkout alone")
    options = parser.parse_args()
    if options.make:
        make(CHECKOUT, options.make)
        return 0
    if not options.commit:
        parser.error("expected a commit, or --make DIR")
    with tempfile.TemporaryDirectory() as temporary:
        other = Path(temporary) / "checkout"
        subprocess.run(
            ["git", "worktree", "add", "--detach", str(other), options.commit],
            cwd=CHECKOUT,
            check=True,
            capture_output=True,
        )
        try:
            _write_metadata(other)
            # The other commit's command, where it has one, knows its own names of settings.
            maker = other / "tools" / Path(__file__).name
            if maker.exists():
                subprocess.run([sys.executable, str(maker), "--make", f"{temporary}/other"], check=True)
            else:
                make(other, Path(temporary) / "other")
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(other)], cwd=CHECKOUT, check=True)
        _write_metadata(CHECKOUT)
        make(CHECKOUT, Path(temporary) / "this")
        there, here = sums(Path(temporary) / "other"), sums(Path(temporary) / "this")
    different = sorted(name for name in there.keys() | here.keys() if there.get(name) != here.get(name))
    for name in different:
        print(f"differs: {name}")
    print(f"{len(there.keys() | here.keys()) - len(different)} equal, {len(different)} different")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
