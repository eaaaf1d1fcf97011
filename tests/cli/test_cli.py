import importlib
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import neuprim
from neuprim.cli import COMMANDS, main
from neuprim.cli.model_commands import print_export_report
from neuprim.config import Job, RunConfig
from neuprim.core.environment import EnvironmentFile
from neuprim.core.errors import NonFiniteError
from neuprim.core.extensions import ExportReport
from neuprim.plugins.registry import TASKS, list_scene_names
from neuprim.runs.fit import Events
from neuprim.runs.render_images import RenderRequest
from tests.plugins.extras import add
from tests.plugins.fakes import site, toy

__all__ = ["site", "toy"]


MODULES_WITH_LOAD_RUN = [
    *(f"neuprim.runs.{name}" for name in ("export", "measure", "render_images")),
    *(f"neuprim.search.{name}" for name in ("compress", "pruning", "tradeoff_measuring")),
]

METRICS: dict[str, Any] = {
    "task": "toy",
    "psnr": None,
    "psnr_infinite": True,
    "ssim": 0.97654,
    "lpips": None,
    "psnr_worst": 27.0,
    "worse_than_black_image": ["r_3"],
    "per_view": [{"psnr": 27.0}, {"psnr": None, "psnr_infinite": True}],
    "primitives": 12,
    "model_bytes": 225_400,
    "render_fps": 12.5,
}


@pytest.fixture
def calls(toy: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace the functions that do the work by ones that record what they were given."""
    made: list[Any] = []

    def run(config: RunConfig, events: Events, launcher: Any = None) -> Path:
        made.append(config)
        config.output_dir.mkdir(parents=True)
        (config.output_dir / "config.yaml").write_text(config.to_yaml())
        (config.output_dir / "metrics.json").write_text(json.dumps(METRICS))
        return config.output_dir

    def evaluate_run(run_dir: Path, lpips: Path | None = None, words: Any = ()) -> dict[str, Any]:
        made.append((run_dir, *words) if words else run_dir)
        return METRICS

    def load_run(run_dir: Path) -> Any:
        """A run without a model."""
        return SimpleNamespace(directory=run_dir, task=Job.of(RunConfig.from_yaml(run_dir)).task)

    def render_run(run: Any, request: Any, **callbacks: Any) -> list[Path]:
        made.append((getattr(run, "directory", run), request))
        return [Path("a.png"), Path("b.png")]

    for module in MODULES_WITH_LOAD_RUN:  # a first import inside the test would keep the replacement
        importlib.import_module(module)
    monkeypatch.setattr("neuprim.runs.open.load_run", load_run)
    monkeypatch.setattr("neuprim.runs.run.run", run)
    monkeypatch.setattr("neuprim.runs.measure.evaluate_run", evaluate_run)
    monkeypatch.setattr("neuprim.runs.render_images.render_run", render_run)
    return made


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on standard error."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("neuprim: error: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


# ---------------------------------------------------------------- run


def test_print_config_prints_and_stops(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    Path("full").mkdir()
    Path("full/x").touch()
    assert main(["run", "--print-config", "task=toy", "--out", "full"]) == 0
    Path("config.yaml").write_text(capsys.readouterr().out)
    assert RunConfig.from_yaml("config.yaml").train.iterations == 7
    assert calls == []


def test_a_run_ends_with_what_it_reached_and_what_to_do_next(
    calls: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for installed, words in ((object(), "view 'a b'"), (None, "render 'c d' --camera orbit")):
        monkeypatch.setattr("neuprim.cli.progress.find_spec", lambda name, found=installed: found)
        folder = words.split("'")[1]
        assert main(["run", "task=toy", "--out", folder]) == 0
        reached = f"PSNR 27.00 dB, SSIM 0.977 (2 held-out views, 1 exact), 225 kB, report: {folder}/report.html"
        assert capsys.readouterr().out == f"{reached}\nnext: neuprim {words}\n"


def test_sweep_with_the_flag_anywhere(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "task=toy", "-m", "model.primitives=2,3", "seed=1,2"]) == 0
    assert [(c.model.primitives, c.seed) for c in calls] == [(2, 1), (2, 2), (3, 1), (3, 2)]
    assert Path("outputs/toy-ball-sweep/model.primitives-3_seed-2/config.yaml").is_file()
    assert "[4/4]" in capsys.readouterr().out


def test_a_failing_combination_does_not_lose_the_others(
    calls: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran = []

    def run(config: RunConfig, events: Events, launcher: Any = None) -> Path:
        ran.append(config.seed)
        if config.seed == 1:
            raise NonFiniteError("w2 of primitive 3")
        return config.output_dir

    monkeypatch.setattr(sys.modules["neuprim.runs.run"], "run", run)
    assert main(["run", "task=toy", "-m", "seed=1,2"]) == 2
    assert ran == [1, 2]
    assert capsys.readouterr().err == "neuprim: error: outputs/toy-ball-sweep/seed-1: w2 of primitive 3\n"


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        (["rn"], "rn: no such command; did you mean 'run'"),
        (["--versoin"], "--help"),
        (["run", "--confg", "x"], "--confg: no such argument of `neuprim run`; did you mean '--config'"),
        (
            ["run", "task=toy", "output_dir=x"],
            "output_dir=x: `neuprim run` does not take output_dir; expected --out DIR",
        ),
        (["truth", "output_dir=x"], "output_dir=x: `neuprim truth` does not take output_dir; leave it out"),
        (["run", "toy"], "toy: expected KEY=VALUE; did you mean: neuprim run task=toy?"),
        (["run", "bal"], "bal: expected KEY=VALUE (see neuprim run --help)"),
        (["run", "ball", "seed=2"], "ball: expected KEY=VALUE; did you mean: neuprim run task=toy scene=ball seed=2?"),
        (
            ["run", "static", "-m", "solids"],
            "static solids: expected KEY=VALUE; did you mean: neuprim run task=static scene=solids?",
        ),
        (["truth", "smoke_fire", "task=dynamic"], "did you mean: neuprim truth scene=smoke_fire task=dynamic?"),
        (["run", "smoke_fire", "task=static"], "smoke_fire: expected KEY=VALUE (see neuprim run --help)"),
        (["run", "task=toi"], "did you mean 'toy'"),
        (["run", "task=toy", "train.iterations=x"], "expected a whole number"),
        (["run", "task=toy", "seed=1,2"], "add -m"),
        (["eval", "nowhere"], "nowhere: no such run directory"),
        (["render", "nowhere", "--camera", "orbit"], "nowhere: no such run directory"),
        (["render", "."], "--camera"),
        (["render", ".", "--camera", "spiral"], "expected orbit, test, or a file or folder of cameras"),
        (["render", ".", "--camera", "orbit", "--size", "640"], "expected WIDTHxHEIGHT"),
        (["render", ".", "--camera", "orbit", "--frames", "0"], "expected a positive count"),
        (["render", ".", "--camera", "orbit", "--time", "0"], "config.yaml: missing"),
        (["vdb", "info", "x" * 300], "File name too long"),
        (["tasks", "more"], "more: no such argument of `neuprim tasks`"),
        (
            ["run", "-m", "task=toy", "target.psnr=30", "budget=5m", "seed=1,2"],
            "a run with a target cannot be combined with -m",
        ),
        (
            ["run", "-m", "viewer=true", "seed=1,2"],
            "viewer=true: the viewer shows a single run and cannot be combined with -m",
        ),
        (["view", "."], "config.yaml: missing"),
        (["view", ".", "--port", "80000"], "--port 80000: expected a port, 1 to 65535, or 0 for any"),
    ],
)
def test_one_line_and_status_2(
    calls: list[Any], capsys: pytest.CaptureFixture[str], argv: list[str], text: str
) -> None:
    assert main(argv) == 2
    assert text in error_line(capsys)
    assert calls == []


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (KeyboardInterrupt(), 130, "neuprim: interrupted; outputs/toy-ball has no checkpoint yet"),
        (torch.OutOfMemoryError("CUDA out of memory."), 2, "memory is full; expected a smaller image or grid"),
        (ZeroDivisionError(), None, ""),
    ],
)
def test_status_and_message_of_errors(
    error: BaseException,
    status: int | None,
    text: str,
    calls: list[Any],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A bug keeps its traceback."""

    def fail(*args: Any, **options: Any) -> Path:
        raise error

    monkeypatch.setattr(sys.modules["neuprim.runs.run"], "run", fail)
    if status is None:
        with pytest.raises(type(error)):
            main(["run", "task=toy"])
    else:
        assert main(["run", "task=toy"]) == status and text in capsys.readouterr().err


def test_an_interrupted_run_says_where_it_is_and_how_to_go_on(
    calls: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The words that it prints, read by a shell, are a command that resumes."""
    started: list[RunConfig] = []

    def stop(config: RunConfig, events: Events, launcher: Any = None) -> Path:
        config.output_dir.mkdir(parents=True, exist_ok=True)
        if config.seed == 3:
            (config.output_dir / "checkpoint.safetensors").touch()
        started.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["neuprim.runs.run"], "run", stop)
    nasty = "it's a=b, $c"
    for words, where, said in (
        (
            ["task=toy", "seed=3", "train.rates={means: 1e-3, other: 2}", "task.options.gain=2.5"],
            "outputs/toy-ball",
            "outputs/toy-ball contains a checkpoint of the run",
        ),
        (["--out", nasty, "task=toy", "seed=4"], nasty, f"{nasty} has no checkpoint yet"),
        (["task=toy", "seed=3", "resume=false", "--out=o"], "o", "o contains a checkpoint of the run"),
        (
            ["-m", "task=toy", "seed=3,4", "model.primitives=2,3"],
            "outputs/toy-ball-sweep/seed-3_model.primitives-2",
            "outputs/toy-ball-sweep has 0 of 4 finished runs, and checkpoints of 1 others",
        ),
    ):
        assert main(["run", *words]) == 130
        first, second = capsys.readouterr().err.splitlines()
        assert first == f"neuprim: interrupted; {said}; to continue:"
        assert second.startswith("  neuprim run ")
        assert main(shlex.split(second)[1:]) == 130
        assert capsys.readouterr().err.splitlines()[1] == second, "the same words again"
        before, after = started[-2:]
        assert after.resume and not before.resume and after.output_dir == before.output_dir == Path(where)
        assert (after.seed, after.train, after.model, after.options) == (
            before.seed,
            before.train,
            before.model,
            before.options,
        )


def test_a_target_prints_what_came_of_it(
    calls: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["run", "task=toy", "target.ssim=0.9", "target.megabytes=2", "budget=5m", "--out", "out"]
    assert main([*words, "--print-config"]) == 0
    first = "# target.ssim=0.9 target.megabytes=2 budget=300s; the search starts from\ntask:\n"
    assert capsys.readouterr().out.startswith(first)
    achieved: dict[str, Any] = {"predicted": {"psnr": (30.0, 0.5)}, "run_dir": "out", "file": "model.neuprim"}
    achieved |= {key: {"psnr": 29.5} for key in ("held_out", "test")}
    achieved |= dict.fromkeys(("primitives", "packed_bytes", "model_bytes", "seconds", "fps"), 1234)
    record = SimpleNamespace(achieved=achieved, asked={"budget": 300.0}, why=["enough"], warning="psnr is missed")
    monkeypatch.setattr("neuprim.search.target.run_target", lambda *args, **options: record)
    Path("out").mkdir()
    Path("out/metrics.json").write_text(json.dumps(METRICS))
    assert main([*words, "resume=true"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("PSNR 27.00 dB, SSIM 0.977") and out.splitlines()[1].startswith("next: neuprim ")
    for text in ("predicted psnr ", "model.neuprim 1,234 bytes", "s of 300 s used", "ended: enough", "psnr is missed"):
        assert text in err

    def interrupt(*args: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("neuprim.search.target.run_target", interrupt)
    shutil.rmtree("out")
    assert main(words) == 130
    first, second = capsys.readouterr().err.splitlines()
    assert first == "neuprim: interrupted; out holds the trials trained so far; to continue:"
    assert second == f"  neuprim {' '.join(words)} resume=true"


# ---------------------------------------------------------------- eval, render, export


def test_eval_prints_six_metrics_unless_all_are_asked_for(
    calls: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("r").mkdir()
    assert main(["eval", "r", "resolution=0.5"]) == 0 and calls == [(Path("r"), "resolution=0.5")]
    out, err = capsys.readouterr()
    rows = [
        "psnr         inf",
        "ssim         0.9765",
        "psnr_worst   27.0000",
        "model_bytes  225400",
        "render_fps   12.5000",
    ]
    assert out.splitlines() == rows
    assert err == "neuprim: warning: 1 of 2 held-out views are worse than a black image: r_3\n"
    measured = {**METRICS, "lpips": 0.25, "psnr": 30.0, "psnr_infinite": False}
    monkeypatch.setattr("neuprim.runs.measure.evaluate_run", lambda *args: measured)
    assert main(["eval", "r"]) == 0
    assert capsys.readouterr().out.splitlines()[:3] == ["psnr         30.0000", rows[1], "lpips        0.2500"]
    assert main(["eval", "r", "--all"]) == 0
    out = capsys.readouterr().out
    assert "primitives " in out and "task " in out and "per_view " in out and len(out.splitlines()) == len(METRICS)


def test_export_reports_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"iou": 0.5, "frame_1.psnr": float("inf")}
    report = ExportReport((Path("a.vdb"),), False, errors, ("a note",))
    print_export_report(report, False)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["a.vdb", "lossy", "iou           0.5000", "frame_1.psnr  inf", "note: a note"]
    print_export_report(report, True)
    assert json.loads(capsys.readouterr().out)["errors"] == {"iou": 0.5, "frame_1.psnr": None}


def test_render(calls: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    main(["run", "task=toy", "--out", "r"])
    capsys.readouterr()
    assert main(["render", "r", "--camera", "test"]) == 0
    assert calls[-1] == (Path("r"), RenderRequest("test", overrides=[]))
    assert capsys.readouterr().out == "a.png\nb.png\n"
    Path("cams.json").touch()
    flags = "--camera cams.json --size 640x480 --format exr --out o --frames 3 --fps 12 --time 0:1 --light-pos=-1,0,2"
    assert main(["render", "r", *flags.split()]) == 0
    conditions = {"time": "0:1", "light_pos": "-1,0,2"}
    assert calls[-1][1] == RenderRequest("cams.json", (640, 480), "exr", Path("o"), 3, conditions, 12.0, overrides=[])
    for words in (["--light_pos", "-1,0,2"], ["--light-pos", "-1,0,2"], ["--light_pos=-1,0,2"]):
        assert main(["render", "r", "--camera", "orbit", *words]) == 0
        assert calls[-1][1].conditions == {"light_pos": "-1,0,2"}
    capsys.readouterr()
    assert main(["render", "r", "--camera", "orbit", "--tiem", "0"]) == 2
    assert "--tiem: no such argument of `neuprim render` for task 'toy'; did you mean '--time'" in error_line(capsys)
    flags = "--camera orbit --environment sky.exr --environment-samples 9 --environment-rotation=-45"
    assert main(["render", "r", *flags.split()]) == 0
    assert calls[-1][1].environment == EnvironmentFile(Path("sky.exr"), 9, -45.0, 1.0)


# ---------------------------------------------------------------- tasks, help


def test_help_and_version(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"neuprim {neuprim.__version__}\n"
    assert main(["--help"]) == 0
    assert "doctor" in capsys.readouterr().out
    assert main([]) == 0
    capsys.readouterr()
    assert main(["run", "--help"]) == 0
    out = capsys.readouterr().out
    assert "train.iterations=N" in out and "effort=N" in out and len(out.splitlines()) <= 60
    assert "  static   blender, colmap, mesh, nerfstudio, room, solids\n" in out
    assert "  toy      ball, files  (neuprim-toy 0.3)\n" in out
    assert "neuprim run task=static scene=solids" in out


def test_scenes_are_listed_without_importing_their_task(site: Path) -> None:
    """The files of a task in ``conf``, and the scenes that other packages register."""
    add(site, "scene")
    for info in TASKS.list_plugins():
        added = ["extra"] if info.name == "static" else []
        assert list_scene_names(info) == sorted([*(scene.name for scene in TASKS.load(info.name).scenes), *added])


def test_settings_are_anywhere_on_the_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a=b").mkdir()
    settings = ["renderer.samples=2", "resolution=0.5"]
    for words in (["a=b", *settings], [settings[0], "a=b", settings[1]], [*settings, "--lpips", "x=y", "a=b"]):
        arguments = COMMANDS["eval"].parse(words)
        assert (arguments.overrides, arguments.run_dir) == (settings, Path("a=b"))
    assert arguments.lpips == Path("x=y"), "the value of a flag is no setting"
    assert COMMANDS["run"].parse(["a=b", "-m", "c=d", "--out", "e=f"]).overrides == ["a=b", "c=d"]
    assert COMMANDS["tradeoff"].parse(["--views", "3", "task=static"]).run_dir is None


def test_every_command_that_writes_has_the_same_option() -> None:
    writing = {name for name, command in COMMANDS.items() if "--out" in command.build_parser()._option_string_actions}
    assert writing == {*"run render tradeoff export compress prune import inspect new-task blender-addon bench".split()}


def test_help_is_light_and_the_module_runs() -> None:
    heavy = "{'torch', 'numpy', 'hydra', 'omegaconf', 'rich', 'numba'}"
    code = (
        f"import sys, neuprim.cli as c; c.main(['run', '--help']); print(*{heavy} & set(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "\n")
    done = subprocess.run([sys.executable, "-m", "neuprim", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"neuprim {neuprim.__version__}\n")
