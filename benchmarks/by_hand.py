"""What is written by hand, beside the library that does the same: the numbers behind the table in CONTRIBUTING.md.

    python benchmarks/by_hand.py [--rounds N]

Best of N rounds in which both take turns, in one process. ``plyfile`` and ``pydantic`` are no dependencies: measured
where they are installed, else left out. The reader of a damaged file runs in a process of its own, as a library may
take all memory before it gives up.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import make_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.metrics import ssim

from neuprim.core.checked import checked
from neuprim.core.errors import ConfigError
from neuprim.core.io.ply import read_ply, write_ply
from neuprim.core.settings import RenderSettings
from neuprim.core.train.ssim_cpu import photometric_fused
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shapes import build

GAUSSIAN = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity"]
GAUSSIAN += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
READERS = {
    "core/ply.py": "from pathlib import Path; from neuprim.core.io.ply import read_ply; read_ply(Path(path))",
    "trimesh": "import trimesh; trimesh.load(path, process=False)",
    "plyfile": "from plyfile import PlyData; PlyData.read(path)",
}
CLAIM = "ply\nformat ascii 1.0\nelement vertex 3000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"


def best(rounds: int, work: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Seconds of each, the least of all rounds, after one that does not count."""
    found = dict.fromkeys(work, float("inf"))
    for number in range(rounds + 1):
        for name, call in work.items():
            start = time.perf_counter()
            call()
            if number:
                found[name] = min(found[name], time.perf_counter() - start)
    return found


def rays(rounds: int) -> None:
    solids, count = build(), 200_000
    scene, other = Scene(solids, "embree"), Scene(solids, "numba")
    targets = scene.surface_points(count, torch.Generator().manual_seed(0))
    origins = np.tile(np.array([[2.5, -2.0, 1.5]], np.float32), (count, 1))
    seconds = best(rounds, {"embree": lambda: scene._search.first(origins, targets - origins), "bvh.py": lambda: other._search.first(origins, targets - origins)})  # fmt: skip
    rates = ", ".join(f"{name} {count / s:.3g} rays/s" for name, s in seconds.items())
    print(f"first hits on `solids`, one core: {rates}, ratio {seconds['bvh.py'] / seconds['embree']:.1f}")


def similarity(rounds: int) -> None:
    truth, rendered = torch.rand(2, 200, 200, 3, generator=torch.Generator().manual_seed(0))

    def by_kornia() -> None:
        leaf = rendered.clone().requires_grad_()
        pair = (x.permute(2, 0, 1)[None] for x in (leaf, truth))
        (1 - ssim(*pair, window_size=11, padding="valid").mean()).backward()

    def by_hand() -> None:
        leaf = rendered.clone().requires_grad_()
        photometric_fused(leaf, truth, 1.0)[0].backward()

    seconds = best(rounds, {"kornia": by_kornia, "ssim_cpu.py": by_hand})
    print("SSIM and its gradient, 200x200: " + ", ".join(f"{name} {s * 1e3:.1f} ms" for name, s in seconds.items()))


def point_files(rounds: int, folder: Path) -> None:
    rows = np.zeros(100_000, [(name, "<f4") for name in GAUSSIAN])
    path, damaged = folder / "gaussians.ply", folder / "damaged.ply"
    write_ply(path, rows)
    damaged.write_text(CLAIM)
    installed = [name for name in READERS if name == "core/ply.py" or importlib.util.find_spec(name)]
    work: dict[str, Callable[[], object]] = {"core/ply.py": lambda: read_ply(path)}
    if "trimesh" in installed:
        import trimesh

        work["trimesh"] = lambda: trimesh.load(path, process=False)
    if "plyfile" in installed:
        from plyfile import PlyData

        work["plyfile"] = lambda: np.array(PlyData.read(path)["vertex"].data)
    print(
        "100,000 Gaussians of 62 numbers: "
        + ", ".join(f"{name} {s * 1e3:.0f} ms" for name, s in best(rounds, work).items())
    )
    for name in installed:
        code = f"path = {str(damaged)!r}\ntry:\n    {READERS[name]}\n    print('read it')\nexcept Exception as error:\n    print(type(error).__name__, error)"
        limited = f"import resource; resource.setrlimit(resource.RLIMIT_AS, (16 << 30,) * 2)\n{code}"
        done = subprocess.run([sys.executable, "-c", limited], capture_output=True, text=True, check=False)
        print(
            f"  a header that claims 3,000,000,000 vertices in text: {name}: {(done.stdout or done.stderr).strip().splitlines()[-1][:150]}"
        )


def started(rounds: int, work: dict[str, list[str]]) -> dict[str, float]:
    """Seconds that processes take beyond an empty one."""
    words = {"": ["-c", ""], **work}
    seconds = best(rounds, {name: lambda w=w: subprocess.run([sys.executable, *w], check=True, stdout=subprocess.DEVNULL) for name, w in words.items()})  # fmt: skip
    return {name: seconds[name] - seconds[""] for name in work}


def settings(rounds: int) -> None:
    """Start-up, a check of every field, and what lax and strict pydantic make of what the tests of the settings
    demand."""
    work = {"neuprim --help": ["-m", "neuprim", "--help"], "settings": ["-c", "import neuprim.core.settings"]}
    if importlib.util.find_spec("pydantic") is not None:
        work["pydantic"] = ["-c", "from pydantic import TypeAdapter; from pydantic.dataclasses import dataclass"]
    print("seconds to start: " + ", ".join(f"{name} {1e3 * s:.0f} ms" for name, s in started(rounds, work).items()))
    own = RenderSettings()
    made = best(rounds, {"": lambda: [replace(own, near=0.02) for _ in range(1000)]})
    print(f"a check of the {len(vars(own))} fields of RenderSettings: {1e3 * made['']:.0f} microseconds")
    if "pydantic" not in work:
        print("pydantic: not installed")
        return
    from pydantic import ConfigDict, TypeAdapter, ValidationError
    from pydantic.dataclasses import dataclass as pydantic_dataclass

    fields: list[tuple[str, type, Any]] = [("samples", int, 1), ("near", float, 0.01), ("depth", bool, False)]

    def pydantic(strict: bool) -> Any:
        config = ConfigDict(extra="forbid", strict=strict, allow_inf_nan=False)
        return pydantic_dataclass(make_dataclass("Made", fields), config=config)

    lax, strict, plain = pydantic(False), pydantic(True), TypeAdapter(make_dataclass("Plain", fields))

    def verdict(make: Callable[[], Any]) -> str:
        try:
            return repr(make())
        except ValidationError as error:
            return f"refused in {len(str(error).splitlines())} lines"

    def ours(values: dict[str, Any]) -> str:
        try:
            made = checked(RenderSettings, values, "renderer")
            return ", ".join(f"{key}={getattr(made, key)!r}" for key in values)
        except ConfigError as error:
            return str(error)

    for values in (
        {"samples": True},
        {"samples": 4.0},
        {"near": "1e-3"},
        {"near": math.nan},
        {"depth": "yes"},
        {"sampels": 4},
    ):
        found = {
            "here": ours(values),
            "lax": verdict(lambda v=values: lax(**v)),
            "strict": verdict(lambda v=values: strict(**v)),
            "a dataclass that does not know pydantic": verdict(lambda v=values: plain.validate_python(v)),
        }
        print(f"  {values}: " + "; ".join(f"{name}: {text}" for name, text in found.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rays(args.rounds)
    similarity(args.rounds)
    with tempfile.TemporaryDirectory() as folder:
        point_files(args.rounds, Path(folder))
    settings(args.rounds)


if __name__ == "__main__":
    main()
