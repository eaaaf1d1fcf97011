"""A page beside a training: it pauses, steps, saves and stops it, and the model ends with the bits that it has
without."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the package viser is not installed")

import neuprim.viewer.session as sessions
from neuprim.config import RunConfig, compose
from neuprim.config.command_settings import ViewerSettings
from neuprim.core import checkpoint
from neuprim.runs.fit import Event, Fitted, Note, Step
from neuprim.runs.run import run
from neuprim.viewer.view import LiveTraining
from tests.core import tiny
from tests.short_runs import words
from tests.viewer_client import Visitor, visit

STEPS = 120


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def trained(config: RunConfig, live: LiveTraining | None = None) -> None:
    """To the end, in this thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        if live is None:
            run(config)
        else:
            run(config, live, live.between)


def state(config: RunConfig) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Header and tensors of the checkpoint: parameters, moments, statistics, random numbers; without seconds."""
    header, tensors = checkpoint.read_tensors(config.output_dir / "checkpoint.safetensors", "checkpoint")
    return {name: value for name, value in header.items() if name != "elapsed"}, tensors


class Watched:
    """A training with a page, whose visitor does something at certain steps, on a thread of its own."""

    def __init__(self, config: RunConfig, visitor: Callable[[LiveTraining, Visitor], None]) -> None:
        self.events: list[Event] = []
        self.failures: list[BaseException] = []
        self.live = LiveTraining(ViewerSettings(port=0), config, lambda address: None, self.events.append)
        self._begun = threading.Event()

        def look() -> None:
            try:
                self._begun.wait(60)
                with visit(self.live.address) as page:
                    page.stand()
                    visitor(self.live, page)
            except BaseException as error:
                self.failures.append(error)
            finally:
                self.live.pause(False)

        thread = threading.Thread(target=look)
        thread.start()
        self.live.pause(True)  # so that the first picture is of the first step
        between = self.live.between

        def begun(fitted: Fitted, stop: threading.Event) -> None:
            self._begun.set()
            between(fitted, stop)

        with self.live:
            self.live.between = begun  # type: ignore[method-assign]
            try:
                trained(config, self.live)
            except KeyboardInterrupt:
                pass
            thread.join(60)
        assert not thread.is_alive() and not self.failures, self.failures

    @property
    def steps(self) -> list[int]:
        return [event.report.step for event in self.events if isinstance(event, Step)]


def until(page: Visitor, condition: Callable[[], bool]) -> None:
    page.hear(40.0, lambda messages: condition())
    assert condition()


def test_a_training_that_is_looked_at_ends_with_the_same_bits(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody turns the model, looks at a held-out view and at ellipsoids, pauses and steps; the checkpoint is the
    same to the bit."""
    monkeypatch.setattr(sessions, "_REDRAW_SECONDS", 0.0)
    monkeypatch.setattr(sessions, "_REDRAW_SHARE", 0.0)  # draws after every step
    alone, looked_at = (compose(words(scene, tmp_path / name, STEPS)) for name in ("alone", "looked_at"))
    trained(alone)
    seen: dict[str, int] = {}
    between = LiveTraining.between

    def compare_states(live: LiveTraining, fitted: Fitted, stop: threading.Event) -> None:
        before = random_states()
        between(live, fitted, stop)
        assert random_states() == before, "a loss of a plugin may draw from them"

    monkeypatch.setattr(LiveTraining, "between", compare_states)

    def look(live: LiveTraining, page: Visitor) -> None:
        until(page, lambda: len(page.pictures()) > 1)
        assert live.progress.step == 0
        for i in range(3):
            live.step_once()
            until(page, lambda wanted=i + 1: live.progress.step == wanted)  # type: ignore[misc]
        page.hear(0.5)
        assert live.progress.step == 3
        page.set("pause", False)
        for turn in range(6):
            count = len(page.pictures())
            page.stand((0.2 * turn, -4.0, 1.0))
            until(page, lambda before=count: len(page.pictures()) > before or live.progress.step == STEPS)  # type: ignore[misc]
        page.set("pause", True)
        page.set("held-out view", page_view(page))
        until(page, lambda: any(m["type"] == "GuiImageMessage" for m in page.messages))
        page.set("ellipsoids", "wire")
        until(page, lambda: any(m["type"] == "BatchedMeshesMessage" for m in page.messages))
        seen["pictures"] = len(page.pictures())
        page.set("pause", False)

    watched = Watched(looked_at, look)
    assert watched.steps == list(range(1, STEPS + 1)) and seen["pictures"] > 8
    first, second = state(alone), state(looked_at)
    assert first[0] == second[0] and first[1].keys() == second[1].keys() and len(first[1]) > 10
    assert [name for name, value in first[1].items() if not torch.equal(value, second[1][name])] == []


def random_states() -> tuple[Any, ...]:
    """Of torch, numpy and Python; and the number of threads."""
    numpy_state: Any = np.random.get_state()
    own = torch.get_rng_state().numpy().tobytes(), numpy_state[1].tobytes(), random.getstate()
    return *own, torch.get_num_threads()


def page_view(page: Visitor) -> str:
    """A held-out view that the page offers."""
    message = next(m for m in page.messages if m.get("props", {}).get("label") == "held-out view")
    return str(message["props"]["options"][1])


def test_a_checkpoint_now_and_a_stop_that_can_be_resumed(scene: Path, tmp_path: Path) -> None:
    alone, stopped = (compose(words(scene, tmp_path / name, STEPS)) for name in ("alone", "stopped"))
    trained(alone)

    def look(live: LiveTraining, page: Visitor) -> None:
        until(page, lambda: len(page.pictures()) > 0)
        live.step_once()
        until(page, lambda: live.progress.step == 1)
        live.checkpoint()
        file = stopped.output_dir / "checkpoint.safetensors"
        until(page, lambda: any(m["type"] == "NotificationShowMessage" and "is saved" in str(m) for m in page.messages))
        assert checkpoint.read_tensors(file, "checkpoint")[0]["step"] == 1
        live.stop()

    watched = Watched(stopped, look)
    assert watched.steps == [1] and (stopped.output_dir / "report.html").exists()
    assert {"paused by its viewer"} <= {event.text for event in watched.events if isinstance(event, Note)}
    trained(compose(words(scene, tmp_path / "stopped", STEPS, "resume=true")))
    first, second = state(alone)[1], state(stopped)[1]
    assert all(torch.equal(value, second[name]) for name, value in first.items())


def test_a_pause_is_kept_while_numbers_are_updated(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """viser stores the value of the box first and calls the viewer a moment later, on another thread."""
    monkeypatch.setattr(sessions, "_REDRAW_SECONDS", 0.0)
    monkeypatch.setattr(sessions, "_REDRAW_SHARE", 0.0)
    monkeypatch.setattr("neuprim.viewer.view._UPDATE_SECONDS", 0.0)
    pause = LiveTraining.pause

    def pause_late(live: LiveTraining, paused: bool) -> None:
        time.sleep(0.3)
        pause(live, paused)

    def look(live: LiveTraining, page: Visitor) -> None:
        until(page, lambda: len(page.pictures()) > 0)
        page.set("pause", False)
        until(page, lambda: live.progress.step > 3)
        monkeypatch.setattr(LiveTraining, "pause", pause_late)
        page.set("pause", True)
        page.hear(2.0)
        kept = live.paused
        live.stop()
        assert kept

    Watched(compose(words(scene, tmp_path / "out", 100_000)), look)


def test_a_picture_that_fails_ends_no_training(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    def broken(*args: Any) -> None:
        raise RuntimeError("no such picture")

    monkeypatch.setattr("neuprim.viewer.viewer_scene.ViewerScene.draw", broken)

    def look(live: LiveTraining, page: Visitor) -> None:
        until(page, lambda: any("no such picture" in str(m) for m in page.messages))

    watched = Watched(compose(words(scene, tmp_path / "out", 10)), look)
    assert watched.steps == list(range(1, 11)) and "RuntimeError: no such picture" in capfd.readouterr().err


def test_nobody_who_looks_costs_one_question(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without visitors nothing is drawn, and the desk is not asked for work."""
    config, events = compose(words(scene, tmp_path / "out", 20)), list[Event]()
    with LiveTraining(ViewerSettings(port=0), config, lambda address: None, events.append) as live:
        monkeypatch.setattr(live.queue, "work", lambda patience: pytest.fail("asked for work"))
        trained(config, live)
    assert live.progress.step == 20
