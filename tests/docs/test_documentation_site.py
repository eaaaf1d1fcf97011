"""What the site's hooks do to links, docstrings and pages that load from the network. Needs mkdocs
(``neuprim[docs]``)."""

from __future__ import annotations

import importlib.util
import logging
from types import SimpleNamespace
from typing import Any

import pytest

from tests.docs.pages import ROOT

for package in ("mkdocs", "material", "mkdocstrings"):
    pytest.importorskip(package)


def load(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"documentation_{name}", ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def hooks() -> Any:
    return load("hooks")


def page(uri: str) -> Any:
    return SimpleNamespace(file=SimpleNamespace(src_uri=uri))


def test_files_beside_the_pages_come_along(hooks: Any) -> None:
    from mkdocs.config import load_config
    from mkdocs.structure.files import Files

    config = load_config(str(ROOT / "mkdocs.yml"))
    files = Files([])
    text = "[a](../examples/train_your_own.py) [b](../CONTRIBUTING.md) [c](../no.md) [d](dynamic.md)"
    changed = hooks.on_page_markdown(text, page("rasterize.md"), config, files)
    assert changed == "[a](examples/train_your_own.py) [b](contributing.md) [c](../no.md) [d](dynamic.md)"
    assert [file.src_uri for file in files] == ["examples/train_your_own.py"]
    assert hooks.on_page_markdown("[d](../dynamic.md)", page("api/vdb.md"), config, files) == "[d](../dynamic.md)"
    changes = hooks.on_page_markdown("", page("changelog.md"), config, files)
    assert "](relighting.md)" in changes and "](docs/" not in changes


def test_roles_become_links(hooks: Any) -> None:
    made = hooks.on_page_content("see :class:<code>~neuprim.core.errors.DataError</code>.")
    assert made == 'see <autoref identifier="neuprim.core.errors.DataError" optional><code>DataError</code></autoref>.'


def test_a_page_that_loads_from_the_network_is_a_warning(hooks: Any, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        hooks.on_post_page('<a href="https://arxiv.org/x">x</a> <img src="pictures/a.png">', page("a.md"))
        assert caplog.messages == []
        hooks.on_post_page('<script src="https://a.b/c.js">', page("a.md"))
    assert len(caplog.messages) == 1 and "a.md would load" in caplog.messages[0]


def test_comments_of_fields_become_entries() -> None:
    import griffe

    comments = load("field_comments")
    text = "A box.\n\nAttributes:\n    b: second,\n        on two lines.\n"
    merged = comments.merge_entries(text, {"c": "third", "a": "first"}, ["a", "b", "c"])
    assert merged == "A box.\n\nAttributes:\n    a: first\n    b: second,\n        on two lines.\n    c: third\n"
    assert comments.merge_entries("A box.", {"a": "first"}, ["a"]) == "A box.\n\nAttributes:\n    a: first\n"
    extensions = griffe.load_extensions(comments.FieldComments)
    package = griffe.GriffeLoader(search_paths=[ROOT], extensions=extensions).load("neuprim")
    shown = package["core.render.output.RenderOutput"].docstring.parse("google")[-1].value
    assert [entry.name for entry in shown] == ["rgb", "alpha", "depth"]
    assert shown[2].description.startswith("(H, W) weighted mean camera-z") and "None without" in shown[2].description
