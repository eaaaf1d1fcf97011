"""Third-party loaders, tasks and losses that crash or hand over nonsense: one line names the package, the traceback is
in a file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.plugins.blame import Suspects, blamed, origin_of
from neuprim.plugins.mechanism import PluginError, PluginInfo
from neuprim.plugins.registry import TASKS
from tests.plugins.fakes import install, site

__all__ = ["site"]

SCENE = """
from dataclasses import replace

import torch

from neuprim.core.data import Dataset, Pixels, PointCloud
from neuprim.core.errors import DataError
from neuprim.core.extensions import SceneExtension
from neuprim.core.task import SceneSpec
from tests.core.tiny import Views, near_the_truth, two_primitives


class MyViews(Views):
    def view(self, index):
        {view}
        return super().view(index)

    def pixels(self, index):
        {pixels}
        return super().pixels(index)


def start(views, count, generator):
    {points}
    return near_the_truth(views, count, generator)


def load(settings, context):
    changes = {{}}
    {load}
    return two_primitives(views=MyViews, start=start, **changes)


PLUGIN = SceneExtension(api=1, task="static", scene=SceneSpec("mine", "two ellipsoids", load), config_package="fake_scene.conf")
"""
PLACES = ("view", "pixels", "points", "load")

LOSS = """
from neuprim.core.extensions import LossExtension

def make(settings):
    {make}
    def loss(rendered, truth, frame):
        {loss}
        return (rendered - truth).abs().mean(), {{}}
    return loss

PLUGIN = LossExtension(api=1, name="mine", summary="L1", make=make)
"""

TASK = """
from neuprim.core.model.fields import ColourField, ConditionSpec, Constant
from neuprim.core.model.schema import ParameterSpec
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.train.losses import l1
from neuprim.core.data import Clip
from tests.core.tiny import two_primitives


class Plain(ColourField):
    def __init__(self, channels=3):
        self.channels = channels

    def settings(self):
        return {{"channels": self.channels}}

    def parameters(self):
        return [ParameterSpec("logit", (self.channels,), 5e-2, self.start)]

    def start(self, context):
        {start}
        return context.colors.logit(eps=0.02)

    def lower(self, params, geometry, camera, conditions):
        {lower}
        return Constant(params["logit"].sigmoid())


def build(model, dataset):
    {build}
    return CosineDensity(2), Plain(dataset.channels)


def check(model):
    {check}


def mask(dataset, index):
    {mask}


def judge(dataset, index, rendered, truth):
    {judge}
    return {{}}


def diagnose(dataset, model):
    {diagnose}
    return {{}}


def clips(dataset):
    {clips}
    return ()


def facts(dataset):
    {facts}
    return {{}}


def orbit(dataset, frames):
    {orbit}
    return dataset.orbit(frames)


TASK = TaskSpec(
    api=1,
    name="mine",
    summary="x",
    config_package="fake_task.conf",
    scenes=(SceneSpec("two", "two ellipsoids", lambda s, c: two_primitives()),),
    build=build,
    loss=l1,
    check=check,
    fields={{"CosineDensity": CosineDensity, "Plain": Plain}},
    mask=mask,
    judge=judge,
    diagnose=diagnose,
    clips=clips,
    facts=facts,
    orbit=orbit,
)
"""
TASK_PLACES = ("start", "lower", "build", "check", "mask", "judge", "diagnose", "clips", "facts", "orbit")

SMALL = [
    "renderer.backend=reference",
    "model.primitives=8",
    "train.iterations=4",
    "train.max_seconds=null",
    "output_dir=r",
]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, and temporary files beside it."""
    work = tmp_path / "work"
    work.mkdir()
    (tmp_path / "tmp").mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    return work


def scene(site: Path, **code: str) -> list[str]:
    """Installs a scene with code in some of its functions; the words of a run of it."""
    text = SCENE.format(**{place: code.get(place, "pass") for place in PLACES})
    files = {
        "fake_scene/__init__.py": text,
        "fake_scene/conf/__init__.py": "",
        "fake_scene/conf/scene/static/mine.yaml": "{}",
    }
    install(site, "fake-scene", {"static.mine": "fake_scene:PLUGIN"}, files, version="0.7", group="neuprim.scenes")
    return ["task=static", "scene=mine", "model.neurons=1", "model.sh_degree=0", *SMALL]


def loss(site: Path, **code: str) -> list[str]:
    text = LOSS.format(**{place: code.get(place, "pass") for place in ("make", "loss")})
    install(
        site,
        "fake-loss",
        {"mine": "fake_loss:PLUGIN"},
        {"fake_loss/__init__.py": text},
        version="1.2",
        group="neuprim.losses",
    )
    return [*scene(site), "train.loss=mine"]


def task(site: Path, **code: str) -> list[str]:
    text = TASK.format(**{place: code.get(place, "pass") for place in TASK_PLACES})
    conf = {"__init__.py": "", "task/mine.yaml": "{}", "scene/mine/two.yaml": "{}", "preset/mine/quick.yaml": "{}"}
    files = {"fake_task/__init__.py": text, **{f"fake_task/conf/{k}": v for k, v in conf.items()}}
    install(site, "fake-task", {"mine": "fake_task:TASK"}, files, version="2.0")
    return ["task=mine", *SMALL]


def refusal(words: list[str], capsys: pytest.CaptureFixture[str], command: str = "run") -> str:
    capsys.readouterr()
    assert main([command, *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "neuprim: error: " in line]
    assert len(lines) == 1
    return lines[0].partition("neuprim: error: ")[2]


def traceback_of(message: str) -> Path:
    found = re.search(r"; traceback: (\S+)$", message)
    assert found, message
    return Path(found[1])


BOOM = "raise ValueError('boom\\n  twice')"

CRASHES = {
    "loader": (scene, "load", "scene 'mine' of fake-scene 0.7", "load"),
    "view": (scene, "view", "scene 'mine' of fake-scene 0.7", "view"),
    "pixels": (scene, "pixels", "scene 'mine' of fake-scene 0.7", "pixels"),
    "points": (scene, "points", "scene 'mine' of fake-scene 0.7", "start"),
    "loss factory": (loss, "make", "loss 'mine' of fake-loss 1.2", "make"),
    "loss": (loss, "loss", "loss 'mine' of fake-loss 1.2", "loss"),
    "check": (task, "check", "check of task 'mine' of fake-task 2.0", "check"),
    "build": (task, "build", "build of task 'mine' of fake-task 2.0", "build"),
    "initialiser": (task, "start", "task 'mine' of fake-task 2.0", "start"),
    "field": (task, "lower", "task 'mine' of fake-task 2.0", "lower"),
    **{
        place: (task, place, "task 'mine' of fake-task 2.0", place)
        for place in ("mask", "judge", "diagnose", "clips", "facts", "orbit")
    },
}


@pytest.mark.parametrize(("kind", "place", "who", "function"), CRASHES.values(), ids=CRASHES)
def test_a_crash_is_one_line_and_a_file(
    kind, place, who, function, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # type: ignore[no-untyped-def]
    message = refusal(kind(site, **{place: BOOM}), capsys)
    package = "fake_" + who.split(" of fake-")[1].split()[0]
    assert re.match(
        rf"{re.escape(who)}: ValueError: boom twice \(__init__\.py line \d+, in {function}\); traceback: ", message
    )
    file = traceback_of(message)
    text = file.read_text()
    assert (
        text.startswith(f"{who} ({package}:")
        and "Traceback" in text
        and f", in {function}\n" in text
        and "ValueError: boom" in text
    )
    begun = place in (
        "mask",
        "judge",
        "diagnose",
        "orbit",
        "loss",
        "lower",
    )  # after a step or two; clips and facts are looked at before
    assert (file.parent == Path("r/logs").resolve()) == begun == Path("r").exists()


def test_every_place_is_quiet_when_nothing_is_wrong(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *loss(site)]) == 0
    assert not Path("r/logs").exists()
    assert main(["run", *task(site)[:-1], "output_dir=other"]) == 0


def test_a_loader_may_still_refuse_in_its_own_words(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        refusal(scene(site, load="raise DataError('file.xyz: expected light')"), capsys) == "file.xyz: expected light"
    )


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ({"load": "return None"}, "its loader returned None; expected a neuprim.core.data.Dataset"),
        ({"load": "return [1]"}, "its loader returned a list; expected a neuprim.core.data.Dataset"),
        ({"pixels": "return Pixels(torch.zeros(3, 24, 24))"}, "train view v0: rgb is float32 (3, 24, 24); expected float32 (24, 24, 3)"),
        ({"pixels": "p = super().pixels(index); return replace(p, alpha=p.alpha[..., None])"}, "train view v0: alpha is float32 (24, 24, 1)"),
        ({"load": "changes['background'] = torch.ones(4)"}, "two: background is float32 (4,); expected float32 (3,), one number for each"),
        ({"load": "made = two_primitives(); made.test.cameras = []; return made"}, "two: the test split is empty"),
        ({"points": "return PointCloud(torch.zeros(4, 3), torch.zeros(5, 3))"}, "two: starting points: colors is float32 (5, 3); expected float32 (4, 3)"),
        ({"pixels": "if index == 1: return Pixels(torch.zeros(2, 2, 3))"}, "train view v1: rgb is float32 (2, 2, 3); expected float32 (24, 24, 3)"),
        ({"load": "Dataset(name='two')"}, "TypeError: Dataset.__init__() missing 5 required keyword-only arguments: 'train', 'test', 'start'"),
        ({"load": "class Mine(Dataset): pass"}, "TypeError: class Mine(Dataset): a data set is made by calling neuprim.core.data.Dataset(name="),
    ],
)  # fmt: skip
def test_broken_promises_name_the_scenes_package(
    code: dict[str, str], text: str, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refusal([*scene(site, **code), "train.iterations=6"], capsys)
    assert message.startswith("scene 'mine' of fake-scene 0.7: ") and text in message


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (
            {"mask": "import torch; return torch.zeros(2, 2, dtype=torch.bool)"},
            "test view v0: mask is bool (2, 2); expected bool (24, 24)",
        ),
        ({"judge": "return [1]"}, "judge of test view v0: found a list; expected a dictionary with texts as keys"),
        ({"judge": "return {'error': rendered.mean()}"}, "judge of test view v0: error is tensor("),
        ({"judge": "return {'error': float('nan')}"}, "judge of test view v0: error is nan; expected a number"),
        ({"judge": "return {'psnr': 3.0}"}, "judge of test view v0: psnr is a name that all views' numbers have"),
        (
            {"diagnose": "return {'shape': {1, 2}}"},
            "diagnose: shape cannot be written as JSON (Object of type set is not",
        ),
        (
            {"diagnose": "return {'error': float('inf')}"},
            "diagnose: error cannot be written as JSON (Out of range float values",
        ),
        ({"clips": "return [3]"}, "clips: found a int in the list; expected a neuprim.core.data.Clip"),
        ({"clips": "return None"}, "clips: found a NoneType; expected a list of neuprim.core.data.Clip"),
        ({"clips": "return [Clip('round', ['v0'])]"}, "clips: 'round' has view 'v0'; expected indices below 2"),
        ({"clips": "return [Clip('round', [0, 2])]"}, "clips: 'round' has view 2; expected indices below 2"),
        ({"clips": "return [Clip('round', [])]"}, "clips: 'round' has no views; expected indices below 2"),
        ({"facts": "return None"}, "facts: found a NoneType; expected a dictionary"),
        ({"orbit": "return []"}, "orbit: found no views; expected some"),
        ({"orbit": "return [3]"}, "orbit: found a int in the list; expected a neuprim.core.data.View"),
    ],
)
def test_broken_promises_of_judging_name_the_tasks_package(
    code: dict[str, str], text: str, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refusal(task(site, **code), capsys)
    assert message.startswith("task 'mine' of fake-task 2.0: ") and text in message
    assert Path("r").exists() != ({"clips", "facts"} >= code.keys()), "what needs no model is looked at before training"


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (
            {"loss": "return 3.0, {}"},
            "loss 'mine' of fake-loss 1.2: returned a float as its value; expected one number as a tensor",
        ),
        (
            {"loss": "return (rendered - truth).abs(), {}"},
            "returned a tensor of shape (24, 24, 3) as its value; expected one number",
        ),
        ({"loss": "return rendered.detach().mean(), {}"}, "returned a value without gradient"),
        ({"loss": "return rendered.mean(), 3"}, "returned parts of type int; expected a dictionary"),
        (
            {"loss": "return rendered.mean(), {'l1': rendered.mean()}"},
            "returned part 'l1' of type Tensor; expected a number",
        ),
        ({"loss": "return rendered.mean()"}, "loss 'mine' of fake-loss 1.2: TypeError: "),
        ({"make": "return 3"}, "loss 'mine' of fake-loss 1.2: made a int; expected a function"),
        (
            {"make": "return lambda rendered, truth: (rendered.mean(), {})"},
            "takes 2 positional arguments but 3 were given",
        ),
    ],
)
def test_losses_that_return_something_else(
    code: dict[str, str], text: str, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert text in refusal(loss(site, **code), capsys)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("return None", "build of task 'mine' of fake-task 2.0: TypeError: cannot unpack"),
        (
            "return 3, Plain()",
            "build of task 'mine' of fake-task 2.0: the density is of type int; expected a neuprim.core.model.fields.DensityField",
        ),
        ("return CosineDensity(2), Plain(1)", "2.0: the colour has channels=1; expected 3, as data set 'two' has"),
        ("model['options']['width']", "task 'mine' reads task.options.width, which its 'options' does not declare"),
        ("model['sh_degree']", "task 'mine' reads model.sh_degree, which its 'uses' does not declare"),
    ],
)
def test_tasks_that_build_something_else(code: str, text: str, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert text in refusal(task(site, build=code), capsys)


def test_eval_and_render_name_the_package_too(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = task(site)
    assert main(["run", *words]) == 0
    source = site / "fake_task" / "__init__.py"
    import fake_task  # type: ignore[import-not-found]

    fake_task.Plain.lower = _broken(source)
    for command in (["eval", "r"], ["render", "r", "--camera", "orbit", "--frames", "1"]):
        message = refusal(command[1:], capsys, command[0])
        assert message.startswith("task 'mine' of fake-task 2.0: RuntimeError: gone")
        assert traceback_of(message).parent == Path("r/logs").resolve()


def _broken(source: Path):  # type: ignore[no-untyped-def]
    names: dict[str, object] = {"__name__": "fake_task"}
    exec(
        compile(
            "def lower(self, params, geometry, camera, conditions):\n    raise RuntimeError('gone')",
            str(source),
            "exec",
        ),
        names,
    )
    return names["lower"]


# ---------------------------------------------------------------- the two guards alone

OTHERS = PluginInfo("x", "fake-x", "0.1", "a_package_of_theirs:X")
OURS = PluginInfo("x", "neuprim", "0.1.0", "neuprim.tasks.static:TASK")


def test_only_the_pluginss_crashes_are_attributed() -> None:
    with pytest.raises(ValueError, match=r"^plain$"), blamed(OURS, "x"):
        _raises(ValueError("plain"))
    with pytest.raises(ConfigError, match=r"^known$"), blamed(OTHERS, "x"):
        _raises(ConfigError("known"))
    with pytest.raises(KeyboardInterrupt), blamed(OTHERS, "x"):
        _raises(KeyboardInterrupt())
    with pytest.raises(PluginError, match=r"^x of fake-x 0.1: ValueError: theirs; traceback: "), blamed(OTHERS, "x"):
        _raises(ValueError("theirs"))
    with pytest.raises(PluginError, match=r"SystemExit: 3"), blamed(OTHERS, "x"):
        _raises(SystemExit(3))
    with pytest.raises(PluginError, match=r"takes 0 positional arguments"), blamed(OTHERS, "x"):
        (lambda: None)(3)  # type: ignore[call-arg, misc]


def test_a_function_of_neuprim_that_a_plugin_lends_keeps_its_traceback() -> None:
    from neuprim.core.train.losses import photometric

    with pytest.raises(KeyError), blamed(OTHERS, "its loss"):
        photometric({})


def test_a_bug_of_neuprim_keeps_its_traceback(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from neuprim.core.train.optimizer import RowAdam

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(RowAdam, "step", broken)
    with pytest.raises(ZeroDivisionError, match="a bug"):
        main(["run", *loss(site)])


def test_where_the_traceback_goes(here: Path, tmp_path: Path) -> None:
    def crash(folder: Path | None) -> str:
        with pytest.raises(NeuprimError) as caught, blamed(OTHERS, "x", folder):
            _raises(ValueError())
        return str(caught.value)

    run = here / "run"
    assert traceback_of(crash(None)).parent == tmp_path / "tmp"
    assert traceback_of(crash(run / "logs")).parent == tmp_path / "tmp" and not run.exists()
    run.mkdir()
    assert traceback_of(crash(run / "logs")).parent == tmp_path / "tmp", (
        "an empty directory stays one, or the next run refuses it"
    )
    (run / "config.yaml").write_text("x")
    assert traceback_of(crash(run / "logs")).parent == run / "logs"
    crash(run / "logs")
    assert len(list((run / "logs").iterdir())) == 2
    (run / "logs2").write_text("a file")
    assert traceback_of(crash(run / "logs2")).parent == tmp_path / "tmp", (
        "what cannot be kept there is kept with the temporary files"
    )


def test_suspects() -> None:
    suspects = Suspects("static", "solids", "l1")
    assert {p.origin.distribution for p in (suspects.task, suspects.scene, suspects.loss)} == {"neuprim"}
    assert origin_of(TASKS, "nobody", "some.module").origin == "some"
    with pytest.raises(DataError, match=r"^scene 'solids' of neuprim \S+: view x: wrong$"), suspects.watch():
        from neuprim.core.data.dataset_check import DatasetError

        raise DatasetError("view x: wrong")
    with pytest.raises(ValueError, match=r"^ours$"), suspects.watch():
        _raises(ValueError("ours"))


def _raises(error: BaseException) -> None:
    raise error
