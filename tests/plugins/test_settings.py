"""Settings that a task or a loss declares, and those that nobody would read: refused before any data is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core.data import Dataset, View
from neuprim.core.errors import ConfigError
from neuprim.core.task import Supervision
from neuprim.core.train.settings import ModelSettings, TrainSettings, build_settings, loss_settings
from neuprim.plugins.registry import LOSSES, load_task
from neuprim.tasks.static import TASK
from tests.core import tiny
from tests.core.tiny import camera
from tests.plugins.extras import add
from tests.plugins.fakes import site, toy

__all__ = ["site", "toy"]


def toys(*words: str) -> RunConfig:
    return compose(["task=toy", *words], False)


# ---------------------------------------------------------------- task.options


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["task.options.gian=3"], "task.options.gian: task 'toy' has no such option; did you mean 'gain'?"),
        (
            ["task.options.neurons=3"],
            "task.options.neurons: task 'toy' has no such option; did you mean 'model.neurons'?",
        ),
        (["task.options.gain=high"], "task.options.gain=high: expected a finite number"),
        (["task.options.gain.of=3"], "task.options.gain={'of': 3}: expected a finite number"),
        (["task.options=3"], "task.options=3: expected entries, each as task.options.KEY=VALUE"),
    ],
)
def test_wrong_options_are_refused(toy: Path, words: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        toys(*words)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_options_are_complete_typed_and_shown(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert toys().options == {"gain": 1.0} and toys().non_default == {}
    changed = toys("task.options.gain=3")
    assert changed.options == {"gain": 3.0} and isinstance(changed.options["gain"], float)
    assert changed.non_default == {"task.options.gain": (1.0, 3.0)}
    (toy / "conf/task/toy.yaml").write_text("scene: ball\n")
    assert toys().options == {"gain": 1.0}, "the default of the TaskSpec"
    (toy / "conf/task/toy.yaml").write_text("scene: ball\noptions: {gain: 2}\n")
    assert toys().options == {"gain": 2.0}, "the default of the file"
    assert toys("task.options.gain=2").non_default == {}
    assert main(["run", "task=toy", "--print-config"]) == 0
    assert "  options:\n    gain: 2.0\n" in capsys.readouterr().out
    assert main(["tasks"]) == 0
    assert "options     task.options.gain=1.0  of the amplifier" in capsys.readouterr().out


# ---------------------------------------------------------------- options of losses


def test_a_losss_options_belong_to_task_options_while_it_is_chosen(
    toy: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add(site, "loss", package="fake_loss")
    assert toys("train.loss=extra").options == {"gain": 1.0, "weight": 3.0}
    assert toys("train.loss=extra").non_default == {"train.loss": (None, "extra")}
    config = toys("train.loss=extra", "task.options.weight=5")
    assert config.non_default == {"train.loss": (None, "extra"), "task.options.weight": (3.0, 5.0)}
    with pytest.raises(ConfigError, match=r"task.options.weight: task 'toy' has no such option"):
        toys("task.options.weight=5")
    with pytest.raises(
        ConfigError,
        match=r"task.options.wieght: task 'toy' with loss 'extra' has no such option; did you mean 'weight'",
    ):
        toys("train.loss=extra", "task.options.wieght=5")
    settings = loss_settings(LOSSES.load("extra"), config.train, config.options)
    assert settings["options"] == {"weight": 5.0}, "its own only"
    assert build_settings(load_task("toy"), config.model, config.options)["options"] == {"gain": 1.0}
    assert main(["tasks"]) == 0
    assert "    task.options.weight=3.0  of it" in capsys.readouterr().out


# ---------------------------------------------------------------- shared settings that not everybody uses


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("task=toy model.sh_degree=2", "model.sh_degree: task 'toy'{}; it uses model.neurons"),
        ("task=toy model={sh_every:0}", "model.sh_every: task 'toy'{}; it uses model.neurons"),
        ("task=relight train.ssim_weight=0.5", "train.ssim_weight: loss 'compressed'{}"),
        ("task=relight train.loss=null train.ssim_weight=0.5", "train.ssim_weight: task 'relight'{}; it uses model"),
        ("task=static train.loss=l1 train.ssim_weight=0.5", "train.ssim_weight: loss 'l1'{}"),
    ],
)
def test_unused_settings_are_refused_when_typed(toy: Path, words: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(words.split(), False)
    assert str(caught.value).startswith(text.format(" does not use this setting"))


def test_unused_settings_are_refused_in_a_preset(toy: Path) -> None:
    (toy / "conf/preset/toy/quick.yaml").write_text("model: {sh_degree: 2}\n")
    with pytest.raises(
        ConfigError,
        match=r"preset/toy/quick.yaml: model.sh_degree: task 'toy' does not use this setting; it uses model.neurons",
    ):
        toys()
    (toy / "conf/preset/toy/quick.yaml").write_text("train: {ssim_weight: 0.1}\n")
    with pytest.raises(ConfigError, match=r"preset/toy/quick.yaml: train.ssim_weight: task 'toy'"):
        toys()
    (toy / "conf/preset/toy/quick.yaml").write_text("train: {ssim_weight: 0.1, loss: photometric}\n")
    assert toys().train.ssim_weight == 0.1, "the preset's loss uses it"


def test_what_is_not_used_is_not_shown(toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = toys()
    assert config.unused == ("model.sh_degree", "model.sh_every", "train.ssim_weight")
    assert main(["run", "task=toy", "--print-config"]) == 0
    shown = capsys.readouterr().out
    assert "neurons: 8" in shown
    assert not any(name.partition(".")[2] in shown for name in config.unused)
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    assert RunConfig.from_yaml(tmp_path / "config.yaml") == config
    assert "ssim_weight: 0.2" in toys("train.loss=photometric").to_yaml()
    assert compose(["task=static"], False).unused == ()


def test_names_of_initial_values_and_rates_are_checked_before_data() -> None:
    for word, text in (
        ("model.init.alhpa=0.3", r"model.init.alhpa: no such setting; did you mean 'model.init.alpha'"),
        ("train.rates.mean=0.3", r"train.rates.mean: no such parameter; did you mean 'means'"),
        ("train.rate_units.mean=absolute", r"train.rate_units.mean: no such parameter; did you mean 'means'"),
        ("train.rate_units.means=metre", r"train.rate_units.means=metre: expected "),
    ):
        with pytest.raises(ConfigError, match=text):
            compose(["task=dynamic", word], False)


# ---------------------------------------------------------------- what functions get


def test_functions_get_what_they_declare_and_no_more() -> None:
    shy = replace(TASK, uses=("model.neurons",), options={"gain": (1.0, "x")})
    model = build_settings(shy, ModelSettings(neurons=3), {"else": 2})
    assert model["neurons"] == 3 and model["options"] == {"gain": 1.0} and model["primitives"] == 2000
    assert "sh_degree" not in model and model.get("sh_degree", 7) == 7
    with pytest.raises(ConfigError, match=r"task 'static' reads model.sh_degree, which its 'uses' does not declare"):
        model["sh_degree"]
    with pytest.raises(ConfigError, match=r"task 'static' reads task.options.width, which its 'options' does not"):
        model["options"]["width"]
    with pytest.raises(KeyError):
        model["no_such_setting"]
    train = loss_settings(shy, TrainSettings(), {})
    with pytest.raises(ConfigError, match=r"the loss of task 'static' reads train.ssim_weight, which its 'uses' does"):
        train["ssim_weight"]


# ---------------------------------------------------------------- one list of losses


def test_all_built_in_losses_serve_any_task() -> None:
    """Needs an installation of this version: losses come through its entry points."""
    assert {"compressed", "l1", "photometric", "relative"} <= {info.name for info in LOSSES.list_plugins()}
    rendered, truth = torch.full((4, 4, 3), 0.5, requires_grad=True), torch.full((4, 4, 3), 0.25)
    frame = Supervision(View("v", camera(0.0, 0.0)))
    found = {}
    for name in ("compressed", "l1", "relative"):
        value, parts = LOSSES.load(name).make(loss_settings(LOSSES.load(name), TrainSettings(), {}))(
            rendered, truth, frame
        )
        assert parts == {name: value.item()}
        found[name] = value.item()
        for task in ("static", "dynamic", "relight"):
            assert compose([f"task={task}", f"train.loss={name}"], False).train.loss == name
    expected = {
        "l1": 0.25,
        "relative": (0.25 / 0.55) ** 2,
        "compressed": float(torch.tensor([9.0, 5.0]).log().diff().abs() / torch.tensor(17.0).log()),
    }
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_loss_sees_view_mask_alpha_and_progress() -> None:
    seen: list[tuple[Tensor, Tensor, Supervision]] = []
    data: Dataset = tiny.two_primitives(random_background=True)
    mask = torch.ones(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[:, 12:] = False
    data.train.images = [replace(p, mask=mask) for p in data.train.images]  # type: ignore[attr-defined]
    trainer = tiny.trainer(data, 8)

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, Mapping[str, float]]:
        seen.append((rendered.detach(), truth, frame))
        return (rendered - truth).abs().mean(), {}

    trainer.loss = loss  # type: ignore[assignment]
    names = [report.view for report in trainer.run()]
    assert [frame.view.name for _, _, frame in seen] == names
    assert [frame.progress for _, _, frame in seen] == [i / 8 for i in range(8)]
    for rendered, truth, frame in seen:
        index = int(frame.view.name[1:])
        assert frame.view.camera == data.train.view(index).camera and frame.view.conditions == {}
        assert frame.mask is mask and frame.alpha is data.train.pixels(index).alpha
        assert torch.equal(rendered[~mask], truth[~mask]), "masked pixels contribute nothing"
        assert not torch.equal(rendered[mask], truth[mask])
