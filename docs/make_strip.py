"""The moving picture at the top of the README: films of three models side by side.

    neuprim run task=static scene=colmap scene.path=DIR/cup_colmap scene.downsample=2 effort=7 --out CUP
    neuprim run task=dynamic scene=smoke_fire scene.lights=4 train.iterations=4000 --out SMOKE
    neuprim run task=relight scene=olat scene.path=DIR/pt_bunny train.iterations=3200 --out BUNNY
    python docs/make_strip.py CUP SMOKE BUNNY docs/pictures/strip.webp

The cup is seen by a camera that swings in front of it. Its photographs lie on their sides, so up is to their left.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from pathlib import Path

import torch
from PIL import Image

from neuprim.cli import main as neuprim
from neuprim.core.cameras import look_at
from neuprim.runs.open import load_dataset, load_run

SIDE, FRAMES, FPS = 400, 48, 12
SWING, RISE, AWAY, FIELD = 45.0, 30.0, 5.6, 50.0  # degrees, degrees, scene units, degrees
LEAN = 0.5  # of up, towards the cameras: they look down


def write_swing(run: Path, target: Path) -> None:
    """Cameras for ``neuprim render``, on an arc around the point that is nearest to the axes of all photographs."""
    views = load_dataset(load_run(run)).train
    poses = torch.stack([views.view(i).camera.viewmat.double() for i in range(len(views))])
    places = -(poses[:, :3, :3].transpose(1, 2) @ poses[:, :3, 3:])
    across = torch.eye(3).double() - poses[:, 2, :3, None] * poses[:, 2, None, :3]
    center = torch.linalg.solve(across.sum(0), (across @ places).sum(0))[:, 0]
    up, front = -poses[:, 0, :3].mean(0), (places[:, :, 0] - center).mean(0)
    up += LEAN * front * up.norm() / front.norm()
    up /= up.norm()
    front -= (front @ up) * up
    front /= front.norm()
    side, frames = torch.linalg.cross(up, front), []
    for k in range(FRAMES):
        turn, rise = math.radians(SWING) * math.sin(2 * math.pi * k / FRAMES), math.radians(RISE)
        away = math.cos(rise) * (math.cos(turn) * front + math.sin(turn) * side) + math.sin(rise) * up
        pose = look_at(center + AWAY * away, center, up).inverse()
        pose[:3, 1:3] *= -1  # OpenGL
        frames.append({"transform_matrix": pose.tolist()})
    camera = {"camera_angle_x": math.radians(FIELD), "w": SIDE, "h": SIDE, "frames": frames}
    target.write_text(json.dumps(camera), encoding="utf-8")


def main(cup: str, smoke: str, bunny: str, target: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        films = [str(Path(folder) / f"{k}.webp") for k in range(3)]
        write_swing(Path(cup), Path(folder) / "swing.json")
        shared = ["--size", f"{SIDE}x{SIDE}", "--format", "webp", "--out"]
        orbit = ["--camera", "orbit", "--light", "orbit", "--frames", str(FRAMES)]
        neuprim(["render", cup, "--camera", str(Path(folder) / "swing.json"), *shared, films[0]])
        neuprim(["render", smoke, *orbit, "--time", "0.1:1", *shared, films[1]])
        neuprim(["render", bunny, *orbit, *shared, films[2]])
        opened, sheets = [Image.open(film) for film in films], []
        for k in range(FRAMES):
            sheet = Image.new("RGB", (3 * SIDE, SIDE))
            for column, film in enumerate(opened):
                film.seek(k)
                sheet.paste(film.convert("RGB"), (column * SIDE, 0))
            sheets.append(sheet)
        for film in opened:
            film.close()
    sheets[0].save(target, save_all=True, append_images=sheets[1:], duration=1000 // FPS, loop=0, quality=70, method=6)


if __name__ == "__main__":
    main(*sys.argv[1:])
