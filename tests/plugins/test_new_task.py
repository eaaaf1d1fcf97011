"""Whole third-party packages, installed with pip into a folder of their own and used from the command line; nothing is
downloaded."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import neuprim
from neuprim.cli import main
from neuprim.conformance import CHECKS
from neuprim.core.errors import ConfigError
from neuprim.plugins.new_task import write_plugin_package

ROOT = Path(neuprim.__file__).parents[1]
EXAMPLE = ROOT / "examples" / "neuprim-gaussian"


def shell(words: list[str], cwd: Path, site: Path) -> str:
    """Standard output and error of a command that must succeed, with the packages in ``site`` and this neuprim
    importable."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout[-4000:]
    return done.stdout


def pip_install(source: Path, site: Path) -> None:
    offline = ["--disable-pip-version-check", "--no-index", "--no-build-isolation", "--no-deps"]
    shell([sys.executable, "-m", "pip", "install", "-q", *offline, "--target", str(site), str(source)], source, site)


def run_commands(commands: list[str], cwd: Path, site: Path) -> list[str]:
    """Run commands of neuprim in one new process; return what each of them printed."""
    code = (
        "import sys; from neuprim.cli import main\n"
        "for command in sys.argv[1:]:\n"
        "    assert main(command.split()) == 0; print('@', end='', flush=True)"
    )
    return shell([sys.executable, "-c", code, *commands], cwd, site).split("@")[:-1]


def passed(output: str) -> int:
    return int(output.split(" passed")[0].split()[-1])


def install_example(folder: Path) -> tuple[Path, Path]:
    """Install the example package; return its folder, without the package itself, and where it is installed."""
    copy, site = folder / "example", folder / "site"
    shutil.copytree(EXAMPLE, copy, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    pip_install(copy, site)
    shutil.rmtree(copy / "neuprim_gaussian")  # what runs now is what was installed
    return copy, site


SMALL = "scene.size=16 scene.train_views=4 scene.test_views=1 train.iterations=5 --out r"


@pytest.mark.timeout(900)
def test_the_example_installs_and_trains(tmp_path: Path) -> None:
    _, site = install_example(tmp_path)
    listed, _, evaluated, compressed, coarse = run_commands(
        [
            "tasks",
            f"run task=gaussian scene.supersampling=1 model.primitives=40 {SMALL}",
            "eval r",
            "compress r --steps 5",
            "compress r --level 3 --steps 5 --force",
        ],
        tmp_path,
        site,
    )
    assert "gaussian  (neuprim-gaussian 0.1.0)  A static scene of true Gaussian densities" in listed
    assert "BROKEN" not in listed and "psnr" in evaluated
    assert b"BellDensity" in (tmp_path / "r" / "model.safetensors").read_bytes()[:4000]
    assert json.loads((tmp_path / "r" / "metrics.json").read_text())["psnr"] > 5
    assert re.search(r"log_kappa +[0-9]+ +160 ", compressed) and re.search(r"log_kappa +7 +160 ", coarse)
    (tmp_path / "r" / "model.safetensors").unlink()
    assert "psnr" in run_commands(["eval r"], tmp_path, site)[0]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_example_passes_its_own_tests(tmp_path: Path) -> None:
    copy, site = install_example(tmp_path)
    assert passed(shell([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"], copy, site)) > 50


@pytest.mark.timeout(900)
def test_a_new_task_installs_trains_and_passes_its_tests(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site, folder = tmp_path / "site", tmp_path / "mine"
    assert main(["new-task", "wave", "--out", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "neuprim run task=wave" in printed and f"pytest {folder}" in printed
    lines = [p.read_text().count("\n") for p in folder.rglob("*") if p.is_file()]
    assert len(lines) >= 10 and sum(lines) < 200
    pip_install(folder, site)
    shutil.rmtree(folder / "neuprim_wave")
    run = f"run task=wave model.primitives=30 renderer.backend=reference {SMALL}"
    assert "wave  (neuprim-wave 0.1.0)" in run_commands(["tasks", run], tmp_path, site)[0]
    assert (tmp_path / "r" / "report.html").is_file()
    output = shell([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"], folder, site)
    assert passed(output) == len(CHECKS) + 1


@pytest.mark.parametrize("name", ["", "Wave", "3d", "../x", "class", "wäve", "a" * 41])
def test_bad_names_write_nothing(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="lower-case letters, digits and _"):
        write_plugin_package(name)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new-task", "static"]) == 2
    assert f"new-task static: neuprim {neuprim.__version__} already has a task of this name" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_nothing_that_exists_is_touched(tmp_path: Path) -> None:
    target = tmp_path / "there"
    target.mkdir()
    (target / "precious").write_text("x")
    with pytest.raises(ConfigError, match="there: exists already; choose a new folder"):
        write_plugin_package("wave", target)
    assert [p.name for p in target.iterdir()] == ["precious"]


def test_the_default_folder_is_named_after_the_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_plugin_package("two_words")
    assert (
        tmp_path / "neuprim-two-words" / "neuprim_two_words" / "conf" / "preset" / "two_words" / "quick.yaml"
    ).is_file()
    assert not [
        p
        for p in (tmp_path / "neuprim-two-words").rglob("*")
        if "NAME" in p.name or "PACKAGE" in p.name or p.suffix == ".in"
    ]
