"""A run says which packages made it, and is read with these; what happens when they are gone, newer, or another's."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
import yaml

import neuprim
from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core import checkpoint, errors
from neuprim.core.errors import CheckpointError, ConfigError, NeuprimWarning
from neuprim.plugins import provenance
from neuprim.plugins.new_task import write_plugin_package
from neuprim.plugins.provenance import PluginVersion, Provenance
from neuprim.runs.open import load_run
from neuprim.runs.run import run
from tests.plugins.extras import add
from tests.plugins.fakes import install, site, uninstall
from tests.plugins.marked import static_run

__all__ = ["site"]

SMALL = ["scene.size=12", "scene.train_views=3", "scene.test_views=1", "model.primitives=12"]
QUICK = ["train.iterations=2", "train.max_seconds=null", "renderer.backend=reference"]


def glow(site: Path, distribution: str = "neuprim-glow", version: str = "0.1", package: str = "neuprim_glow") -> None:
    """A working task ``glow``."""
    draft = site.parent / "draft"
    if not draft.exists():
        write_plugin_package("glow", draft)
    files = {}
    for path in (draft / "neuprim_glow").rglob("*"):
        if path.is_file():
            name = str(path.relative_to(draft)).replace("neuprim_glow", package)
            files[name] = path.read_text().replace("neuprim_glow", package)
    install(site, distribution, {"glow": f"{package}:TASK"}, files, version=version)


@pytest.fixture
def made(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of ``task=glow`` of neuprim-glow 0.1, in the working directory."""
    monkeypatch.chdir(tmp_path)
    glow(site)
    run(compose(["task=glow", *SMALL, *QUICK, "output_dir=r"]))
    return Path("r")


def error(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(words) == 2
    return capsys.readouterr().err.strip()


def edited(directory: Path, change: dict[str, Any]) -> None:
    """Changes keys of a run's record of makers; None removes one."""
    file = directory / "config.yaml"
    data = yaml.safe_load(file.read_text())
    for key, value in change.items():
        node, names = data["made_by"], key.split(".")
        for name in names[:-1]:
            node = node[name]
        node[names[-1]] = value
    file.write_text(yaml.safe_dump(data))


# ---------------------------------------------------------------- what is written


def test_a_run_records_who_made_it(made: Path) -> None:
    expected = {"neuprim": neuprim.__version__, "task": {"name": "glow", "package": "neuprim-glow", "version": "0.1"}}
    assert yaml.safe_load((made / "config.yaml").read_text())["made_by"] == expected
    assert checkpoint.read_header(made / "checkpoint.safetensors", "checkpoint")["made_by"] == expected
    metrics = json.loads((made / "metrics.json").read_text())
    assert metrics["made_by"] == {"neuprim": neuprim.__version__, "task": "neuprim-glow 0.1"}
    assert "<dt>task made by</dt><dd>neuprim-glow 0.1</dd>" in (made / "report.html").read_text()
    assert RunConfig.from_yaml(made).made_by == Provenance(
        neuprim.__version__, PluginVersion("glow", "neuprim-glow", "0.1")
    )


def test_scene_and_loss_of_other_packages_are_recorded(site: Path, tmp_path: Path) -> None:
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    made_by = compose(["task=static", "scene=extra", "train.loss=extra"], False).made_by
    assert made_by.to_dict() == {
        "neuprim": neuprim.__version__,
        "task": {"name": "static", "package": "neuprim", "version": made_by.task.version},
        "scene": {"name": "extra", "package": "fake-extra", "version": "0.3"},
        "loss": {"name": "extra", "package": "fake-loss", "version": "0.3"},
    }
    assert Provenance.from_dict(made_by.to_dict()) == made_by


# ---------------------------------------------------------------- packages that are gone


def test_without_the_package_every_command_names_it(made: Path, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "r", "--format", "npz", "--out", "r.npz"]) == 0
    uninstall(site, "neuprim-glow")
    text = "this run was made by neuprim-glow 0.1 (task glow), which is not installed"
    for words in (
        ["eval", "r"],
        ["render", "r", "--camera", "orbit"],
        ["export", "r", "--format", "ply"],
        ["inspect", "r", "--out", "x.html"],
        ["run", "--out", "r", "resume=true"],
        ["run", "task=glow", "--out", "r", "resume=true"],
    ):
        assert error(words, capsys) == f"neuprim: error: r/config.yaml: {text}", words
    assert error(["import", "r.npz", "--out", "again"], capsys) == f"neuprim: error: r.npz: {text}"
    assert not Path("again").exists()
    assert "task=glow: no such task" in error(["run", "task=glow"], capsys), "nothing is resumed"
    assert "task=glwo: no such task" in error(["run", "task=glwo", "--out", "r", "resume=true"], capsys), (
        "a typing error"
    )


def test_without_the_package_of_the_scene_or_the_loss(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    words = ["task=static", "scene=extra", "train.loss=extra"]
    run(compose([*words, "output_dir=r", *QUICK, "model.primitives=12"]))
    uninstall(site, "fake-loss")
    assert main(["eval", "r"]) == 0, "only training needs the loss"
    resume = ["run", *words, "--out", "r", "resume=true"]
    told = "neuprim: error: r/config.yaml: this run was made by "
    assert error(resume, capsys) == told + "fake-loss 0.3 (loss extra), which is not installed"
    uninstall(site, "fake-extra")
    text = told + "fake-extra 0.3 (scene extra), which is not installed"
    assert error(["eval", "r"], capsys) == text
    assert error(["render", "r", "--camera", "test"], capsys) == text
    assert error(resume, capsys) == text
    assert main(["export", "r", "--format", "npz"]) == 0, "the model alone needs no scene"


def test_another_package_of_the_same_name_is_not_taken(
    made: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    glow(site, "glow-too", package="glow_too")
    assert main(["eval", "r"]) == 0, "two packages of that name: the run knows which one made it"
    assert "glow_too" not in sys.modules
    uninstall(site, "neuprim-glow")
    assert "r/config.yaml: this run was made by neuprim-glow 0.1 (task glow), which is not installed" in error(
        ["eval", "r"], capsys
    )
    edited(made, {"task.package": "Glow_Too"})
    assert main(["eval", "r"]) == 0
    assert "r/config.yaml: this run" not in capsys.readouterr().err


# ---------------------------------------------------------------- other versions


def test_another_version_is_one_warning(made: Path, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_run(made)
    (site / "neuprim_glow-0.1.dist-info").rename(site / "neuprim_glow-0.2.dist-info")
    metadata = site / "neuprim_glow-0.2.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("0.1", "0.2"))
    capsys.readouterr()
    assert main(["export", "r", "--format", "npz", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["lossless"] is True, "standard output is the JSON alone"
    assert main(["eval", "r"]) == 0
    err += capsys.readouterr().err
    assert [line for line in err.splitlines() if "warning" in line] == [
        "neuprim: warning: r/config.yaml: this run was made by neuprim-glow 0.1 (task glow); installed is "
        "neuprim-glow 0.2"
    ]
    with pytest.warns(
        NeuprimWarning,
        match=r"r/checkpoint.safetensors: .* neuprim-glow 0.1 \(task glow\); installed is neuprim-glow 0.2",
    ):
        run(compose(["task=glow", *SMALL, *QUICK, "train.iterations=3", "output_dir=r", "resume=true"]))
    made_by = RunConfig.from_yaml(made).made_by
    assert made_by.task.version == "0.2", "what went on was made by what is installed"


@pytest.mark.parametrize(
    ("version", "warns"), [("0.1.7", False), ("0.2.0", True), ("0.2.0.dev1", True), ("not a version", True)]
)
def test_another_neuprim_is_a_warning_where_its_minor_version_differs(
    version: str, warns: bool, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = static_run(tmp_path / "r")
    monkeypatch.setattr(provenance, "__version__", version)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_run(folder)
        load_run(folder)
    texts = [f"{folder}/config.yaml: this run was made by neuprim {neuprim.__version__}; this is neuprim {version}"]
    assert [str(w.message) for w in caught if w.category is NeuprimWarning] == (texts if warns else [])


def test_a_run_does_not_go_on_with_another_packages_task(
    made: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    glow(site, "glow-too", "7", package="glow_too")
    before = (made / "checkpoint.safetensors").read_bytes()
    text = (
        "written for task 'glow' of neuprim-glow 0.1; this run uses the task 'glow' of glow-too 7; "
        "use the package that wrote the file"
    )
    told = error(["run", "task=glow-too:glow", *SMALL, *QUICK, "--out", "r", "resume=true"], capsys)
    assert told.endswith(f"neuprim: error: r/checkpoint.safetensors: {text}")
    assert (made / "checkpoint.safetensors").read_bytes() == before
    assert RunConfig.from_yaml(made).made_by == Provenance(
        neuprim.__version__, PluginVersion("glow", "neuprim-glow", "0.1")
    )


# ---------------------------------------------------------------- records from strangers


def task_record(**changes: Any) -> dict[str, Any]:
    return {"neuprim": "0.1", "task": {"name": "static", "package": "neuprim", "version": "1", **changes}}


@pytest.mark.parametrize(
    ("record", "text"),
    [
        (3, "made_by=3: expected settings"),
        ({}, "made_by.neuprim: required and not given"),
        ({"neuprim": "0.1", "tsak": {}}, "made_by.tsak: no such setting; did you mean 'made_by.task'?"),
        (task_record(package="a:b"), "made_by.task.package=a:b: expected a name of at most 200 characters"),
        (task_record(package="a\nb"), "made_by.task.package"),
        (task_record(package="\x1b[31m"), "made_by.task.package"),
        (task_record(name="x"), "made_by.task.name: found 'x'; expected 'static', the value of task.name"),
        ({**task_record(), "loss": {"name": "x", "package": "p", "version": "1"}}, "made_by.loss.name: found 'x'"),
    ],
)
def test_damaged_records(record: Any, text: str, tmp_path: Path) -> None:
    folder = static_run(tmp_path / "r")
    file = folder / "config.yaml"
    data = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump({**data, "made_by": record}))
    with pytest.raises(ConfigError) as caught:
        RunConfig.from_yaml(folder)
    message = str(caught.value)
    assert message.startswith(f"{file}: made_by") and text in message and message.isprintable() and len(message) < 600


def test_a_damaged_record_in_a_checkpoint(made: Path) -> None:
    header, tensors = checkpoint.read_tensors(made / "checkpoint.safetensors", "checkpoint")
    rest = {key: value for key, value in header.items() if key not in ("format", "kind")}
    checkpoint.write_tensors(made / "checkpoint.safetensors", "checkpoint", tensors, {**rest, "made_by": {"task": 3}})
    config = compose(["task=glow", *SMALL, *QUICK, "output_dir=r", "resume=true"])
    with pytest.raises(CheckpointError, match=r"^r/checkpoint.safetensors: made_by"):
        run(config)


def test_warnings_are_said_once_and_can_be_silenced(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for text in ("a", "b", "a"):
            errors.warn_once(text)
    assert [str(w.message) for w in caught] == ["a", "b"]
    with pytest.warns(UserWarning, match="a stranger's") as others, errors.warnings_as_lines():
        errors.warn_once("two\nlines")
        warnings.warn("a stranger's", UserWarning, stacklevel=1)
    assert len(others) == 1 and capsys.readouterr().err == "neuprim: warning: two lines\n"
