"""What the README shows in Python runs as it stands, after the run it talks about."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from neuprim.config import compose
from neuprim.run import run

README = Path(__file__).parents[1] / "README.md"


def test_the_python_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["scene.size=48", "scene.train_views=6", "scene.test_views=2", "model.primitives=50", "model.neurons=2"]
    run(compose(["task=static", "scene=solids", *small, "train.iterations=5", "train.max_seconds=null"]), Console(quiet=True))
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(example, str(README), "exec"), names)
    frame = names["frame"]
    assert frame.rgb.shape == (48, 48, 3) and frame.alpha.shape == frame.depth.shape == (48, 48)
    assert frame.alpha.max() > 0.1
