import subprocess
import sys
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError
from neuprim.plugins.registry import PluginError, list_tasks, load_task, survey
from tests.plugins.fakes import TOY, install, site, toy

__all__ = ["site", "toy"]


def make(site: Path, name: str, source: str, task: str = "", attribute: str = "TASK") -> None:
    install(site, f"neuprim-{name}", {task or name: f"fake_{name}:{attribute}"}, {f"fake_{name}/__init__.py": source})


def test_listing_imports_nothing(site: Path) -> None:
    make(site, "boom", "raise RuntimeError('imported')")
    infos = {info.name: info for info in list_tasks()}
    assert infos["boom"].origin == "neuprim-boom 0.3"
    assert infos["boom"].target == "fake_boom:TASK"
    assert infos["static"].distribution == "neuprim", "the built-in task comes through the same group"


def test_listing_does_not_load_torch() -> None:
    code = "import sys, neuprim.cli; from neuprim.plugins.registry import list_tasks; list_tasks(); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_loads_only_the_one_asked_for(toy: Path, site: Path) -> None:
    make(site, "boom", "raise RuntimeError('imported')")
    assert load_task("toy").summary == "a toy"
    assert "fake_boom" not in sys.modules


def test_unknown_name_suggests(toy: Path) -> None:
    with pytest.raises(ConfigError, match=r"task=tyo: no such task; did you mean 'toy'\?"):
        load_task("tyo")


def test_broken_import_names_plugin_distribution_and_cause(site: Path) -> None:
    make(site, "boom", "import a_module_that_is_not_there")
    with pytest.raises(PluginError) as caught:
        load_task("boom")
    assert str(caught.value) == (
        "task 'boom' of neuprim-boom 0.3: cannot import fake_boom:TASK: ModuleNotFoundError: No module named 'a_module_that_is_not_there'"
    )
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("TASK = 3", "is of type int; expected a neuprim.core.task.TaskSpec"),
        ("x = 1", "AttributeError"),
        ("def f(:", "SyntaxError"),
        ("import sys; sys.exit(3)", "SystemExit"),
        (TOY, "its TaskSpec is named 'toy'"),
        (TOY.replace("api=1", "api=0"), "written for plugin API 0, this neuprim has 1; upgrade neuprim-bad"),
        (TOY.replace("api=1", "api=99"), "written for plugin API 99, this neuprim has 1; upgrade neuprim"),
    ],
)
def test_unusable_plugins(site: Path, source: str, text: str) -> None:
    make(site, "bad", source)
    with pytest.raises(PluginError) as caught:
        load_task("bad")
    assert text in str(caught.value)
    assert "neuprim-bad 0.3" in str(caught.value)


def test_name_clash_names_both_and_stops_nothing_else(toy: Path, site: Path) -> None:
    make(site, "one", TOY, task="same")
    make(site, "two", TOY, task="same")
    expected = r"'same' is registered by neuprim-one 0.3 .* and neuprim-two 0.3 .*; choose task=neuprim-one:same or task=neuprim-two:same$"
    with pytest.raises(PluginError, match=expected):
        load_task("same")
    assert "fake_one" not in sys.modules, "a clash is seen in metadata"
    assert load_task("toy").name == "toy"


def test_survey_reports_the_broken_ones(toy: Path, site: Path) -> None:
    make(site, "boom", "raise RuntimeError('first line\\nsecond')")
    make(site, "one", TOY.replace('"toy"', '"same"'), task="same")
    make(site, "two", TOY, task="same")
    reports = {(r.info.name, r.info.distribution): r for r in survey()}
    assert reports["toy", "neuprim-toy"].spec is not None
    assert "RuntimeError: first line second" in (reports["boom", "neuprim-boom"].error or "")
    assert reports["same", "neuprim-one"].spec is not None, "a clash breaks nobody"
    assert (
        reports["same", "neuprim-one"].note
        == "also registered by neuprim-two 0.3; task=neuprim-one:same chooses this one"
    )
    assert "its TaskSpec is named 'toy'" in (reports["same", "neuprim-two"].error or "")
    assert reports["toy", "neuprim-toy"].note is None
