"""Pictures that a data set names outside of its own folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neuprim.config import Job, compose
from neuprim.core import errors
from neuprim.core.errors import NeuprimWarning
from neuprim.runs.open import load_dataset
from tests.core import tiny


@pytest.mark.parametrize("named", ["../secret.png", "{place}/secret.png", "link.png"])
def test_one_line_names_the_first_and_their_number(tmp_path: Path, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "_said", set())
    folder = tiny.write_blender(tmp_path / "data")
    secret = tmp_path / "secret.png"
    (folder / "train" / "r_0.png").rename(secret)
    (folder / "link.png").symlink_to(secret)
    file = folder / "transforms_train.json"
    document = json.loads(file.read_text())
    document["frames"][0]["file_path"] = named.format(place=tmp_path)
    file.write_text(json.dumps(document))
    config = compose(["task=static", "scene=blender", f"scene.path={folder}"], check_output=False)
    with pytest.warns(
        NeuprimWarning,
        match=rf"data: 1 of its images lie outside of {folder}, the first {secret}; neuprim reads these images, too",
    ) as said:
        assert len(load_dataset(Job.of(config)).train) == 6
    assert len(said) == 1


def test_nothing_is_said_of_those_inside(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    folder = tiny.write_blender(tmp_path / "data")
    (tmp_path / "link").symlink_to(folder)
    config = compose(["task=static", "scene=blender", f"scene.path={tmp_path / 'link'}"], check_output=False)
    load_dataset(Job.of(config))
    assert not [w for w in recwarn if issubclass(w.category, NeuprimWarning)]
