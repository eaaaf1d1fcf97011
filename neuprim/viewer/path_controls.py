"""The editor of a camera path, and the film along it."""

from __future__ import annotations

import shlex
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.conditions import flag
from neuprim.core.errors import ConfigError
from neuprim.viewer.film import film, free_name
from neuprim.viewer.path import CameraPath, Key, condition_texts
from neuprim.viewer.session import Session

__all__ = ["PathControls"]

_NONE = "no key"


class PathControls:
    """Keys: added, gone to, replaced, moved, removed; played, written as a file of cameras, and drawn as a film."""

    def __init__(self, session: Session, run_dir: Path) -> None:
        self.session, self.run_dir, self.path = session, run_dir, CameraPath()
        self._marks: list[Any] = []
        self._filming = threading.Lock()
        gui = session.client.gui
        self._keys = gui.add_dropdown("key", [_NONE], initial_value=_NONE)
        edit = gui.add_button_group("keys", ["add", "set", "remove", "clear"])
        order = gui.add_button_group("order", ["earlier", "later", "go to"])
        self._seconds = gui.add_number("seconds", self.path.seconds, min=0.1, max=600.0, step=0.1)
        self._fps = gui.add_number("frames per second", self.path.fps, min=1.0, max=120.0, step=1.0)
        self._play = gui.add_checkbox("preview", False)
        self._size = gui.add_vector2("size", (640, 360), min=(16, 16), max=(8192, 8192), step=1)
        self._format = gui.add_dropdown("film", ["webp", "mp4", "gif", "png"], initial_value="webp")
        write = gui.add_button_group("write", ["cameras", "film"])
        edit.on_click(
            lambda _: self._guarded(
                {"add": self._add, "set": self._set, "remove": self._remove, "clear": self._clear}[edit.value]
            )
        )
        order.on_click(
            lambda _: self._guarded(
                {"earlier": lambda: self._move(-1), "later": lambda: self._move(1), "go to": self._go}[order.value]
            )
        )
        write.on_click(lambda _: self._guarded({"cameras": self._write, "film": self._film}[write.value]))
        self._play.on_update(lambda _: self._guarded(self._preview) if self._play.value else None)

    def _guarded(self, do: Any) -> None:
        """What fails is said in the page."""
        try:
            self.path.seconds, self.path.fps = float(self._seconds.value), float(self._fps.value)
            do()
        except Exception as error:  # viser's thread would only print it
            self.session.failed(error)

    # ------------------------------------------------------------ keys

    def _index(self) -> int:
        """Of the chosen key; -1 for none."""
        value = str(self._keys.value)
        return -1 if value == _NONE else int(value.split()[1]) - 1

    def _here(self) -> Key:
        return Key(self.session.pose, dict(self.session.conditions))

    def _add(self) -> None:
        at = self._index() + 1 if self.path.keys else 0
        self.path.keys.insert(at, self._here())
        self._show(at)

    def _set(self) -> None:
        if (index := self._index()) >= 0:
            self.path.keys[index] = self._here()
            self._show(index)

    def _remove(self) -> None:
        if (index := self._index()) >= 0:
            del self.path.keys[index]
            self._show(min(index, len(self.path.keys) - 1))

    def _clear(self) -> None:
        self.path.keys.clear()
        self._show(-1)

    def _move(self, by: int) -> None:
        self._show(self.path.move(self._index(), by))

    def _go(self) -> None:
        if (index := self._index()) >= 0:
            key = self.path.keys[index]
            self.session.stand(key.pose)
            self.session.set_conditions(key.conditions)

    def _show(self, index: int) -> None:
        """The list, and the keys in the scene with the way between them."""
        names = [f"key {i + 1}" for i in range(len(self.path.keys))] or [_NONE]
        self._keys.options = names
        self._keys.value = names[max(index, 0)]
        for mark in self._marks:
            mark.remove()
        scene, keys = self.session.client.scene, self.path.keys
        size = 0.06 * max((float(np.linalg.norm(key.pose.position)) for key in keys), default=1.0)
        aspect = self._size.value[0] / self._size.value[1]
        self._marks = [
            scene.add_camera_frustum(
                f"/path/{i}",
                key.pose.fov,
                aspect,
                scale=size,
                thickness=2.0,
                thickness_units="screen",
                color=(255, 160, 60),
                wxyz=key.pose.wxyz,
                position=key.pose.position,
            )
            for i, key in enumerate(keys)
        ]
        if len(keys) > 1:
            way = np.stack([pose.position for pose in self.path.poses(20 * len(keys))])
            self._marks.append(
                scene.add_line_segments(
                    "/path/way",
                    np.stack([way[:-1], way[1:]], 1),
                    (255, 160, 60),
                    thickness=2.0,
                    thickness_units="screen",
                )
            )

    # ------------------------------------------------------------ what comes of them

    def _preview(self) -> None:
        specs, frames = self.session.subject.task.conditions, self.path.frames
        poses, conditions = self.path.poses(frames), self.path.conditions(specs, frames)
        began = time.monotonic()

        def step() -> None:
            index = int((time.monotonic() - began) * self.path.fps)
            if index >= frames or not self._play.value:
                self._play.value = False
                self.session.changed()
                return
            self.session.stand(poses[index])
            self.session.conditions |= conditions[index]
            self.session.draw(pose=poses[index])
            self.session.ask("preview", step)

        self.session.ask("preview", step)

    def _size_asked(self) -> tuple[int, int]:
        return int(self._size.value[0]), int(self._size.value[1])

    def _written(self) -> tuple[Path, dict[str, str]]:
        """The file of cameras; and the texts of the conditions along it."""
        specs = self.session.subject.task.conditions
        world = self.session.subject.world
        texts = condition_texts(self.path.conditions(specs, self.path.frames), specs, world)
        file = free_name(self.run_dir / "cameras" / "path.json")
        file.parent.mkdir(exist_ok=True)
        self.path.write(file, self._size_asked(), world)
        more = [word for name, text in texts.items() for word in (flag(name), text)]
        if any(len(word) > 80 for word in more):
            self.session.tell(f"{file}")
        else:
            self.session.tell(shlex.join(["neuprim", "render", str(self.run_dir), "--camera", str(file), *more]))
        return file, texts

    def _write(self) -> None:
        self._written()

    def _film(self) -> None:
        if not self._filming.acquire(blocking=False):
            raise ConfigError("a film is being drawn; wait for it")
        try:
            self._draw_film()
        finally:
            self._filming.release()

    def _draw_film(self) -> None:
        file, texts = self._written()
        out = film(
            self.run_dir,
            file,
            texts,
            str(self._format.value),
            self.path.fps,
            lambda text, done: self.session.say(f"{text}, {done:.0%}"),
        )
        self.session.tell(f"{out}")
