"""Images of a built-in scene as a data set on disk: what is the same whatever is seen, and by which light.

    transforms_SPLIT.json     the lens, and for every image its pose and whatever else a loader needs
    SPLIT/...                 one or more files per image

How a view looks, and what its files are called, is the scene's own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from neuprim.scenes.cached import cached_folder
from neuprim.scenes.raycast import Scene
from neuprim.scenes.side_by_side import side_by_side

__all__ = ["ImageSet", "Progress"]

V = TypeVar("V")
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class ImageSet(Generic[V]):
    """What one scene says of its images; ``V`` is whatever it keeps of a view until the image is drawn.

    Attributes:
        name: of the scene.
        key: a short hash of all that the files depend on.
        size: width and height in pixels, for messages.
        splits: the views of every split, in order.
        lens: what a transforms file says before its frames.
        build: makes the scene, of solids that do not move.
        frame: (split, view) -> its entry in the transforms file.
        files: view -> the names of its files, in the folder of its split.
        draw: (scene, view, paths) writes these files; called from several threads.
        facts: scene -> what else a transforms file says before its frames.
    """

    name: str
    key: str
    size: int
    splits: Mapping[str, Sequence[V]]
    lens: Mapping[str, float]
    build: Callable[[], Scene]
    frame: Callable[[str, V], Mapping[str, Any]]
    files: Callable[[V], Sequence[str]]
    draw: Callable[[Any, V, Sequence[Path]], None]
    facts: Callable[[Any], Mapping[str, Any]] = lambda scene: {}

    def generate(self, cache_dir: Path, progress: Progress) -> Path:
        """Write the data set unless a complete one is there; returns its folder ``cache_dir/NAME-KEY``.

        Raises:
            DataError: the cache directory cannot be written.
        """
        files = [f"transforms_{split}.json" for split in self.splits]
        files += [
            f"{split}/{file}" for split, views in self.splits.items() for view in views for file in self.files(view)
        ]
        what = f"scene {self.name}: cannot write the generated images"
        return cached_folder(
            Path(cache_dir) / f"{self.name}-{self.key}", files, lambda folder: self._write(folder, progress), what
        )

    def _write(self, folder: Path, progress: Progress) -> None:
        progress(f"{self.name}: building the scene", 0.0)
        scene = self.build()
        text = f"{self.name}: drawing {self.size}x{self.size} images"
        if scene.engine != "embree":
            text += " (without embreex, which would be faster)"
        for split, views in self.splits.items():
            (folder / split).mkdir()
            layout = {**self.lens, **self.facts(scene), "frames": [self.frame(split, view) for view in views]}
            (folder / f"transforms_{split}.json").write_text(json.dumps(layout, indent=1), encoding="utf-8")

        def draw(job: tuple[Path, V]) -> None:
            place, view = job
            self.draw(scene, view, [place / file for file in self.files(view)])

        jobs = [(folder / split, view) for split, views in self.splits.items() for view in views]
        side_by_side(draw, jobs, lambda fraction: progress(text, fraction))
