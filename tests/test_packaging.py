"""The sdist and the wheel, as ``.ci/run`` builds them: whole, or refused by name."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
import zipfile
from configparser import ConfigParser
from email import message_from_bytes
from pathlib import Path
from types import ModuleType

import pytest

import neuprim

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / ".ci" / "package.py"


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("package_script", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_wheel_holds_the_whole_package(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path / "dist")], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    wheel = Path(done.stdout.strip())
    assert wheel.name == f"neuprim-{neuprim.__version__}-py3-none-any.whl"
    assert {p.name for p in wheel.parent.iterdir()} == {wheel.name, f"neuprim-{neuprim.__version__}.tar.gz"}
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (about,) = [n for n in names if n.endswith(".dist-info/METADATA")]
        version = message_from_bytes(archive.read(about))["Version"]
        points = ConfigParser(delimiters=["="])
        points.optionxform = str  # type: ignore[assignment, method-assign]
        points.read_string(archive.read(about.replace("METADATA", "entry_points.txt")).decode())
    assert version == neuprim.__version__
    for suffix in (".py", ".yaml", ".html", ".in", "py.typed"):
        assert any(n.endswith(suffix) for n in names), suffix
    assert not any(n.startswith(("tests", "docs", "examples")) for n in names)
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {g: dict(points[g]) for g in points.sections()} == declared["entry-points"] | {
        "console_scripts": declared["scripts"]
    }


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        pytest.param(
            "pyproject.toml", ', "**/*.html"', "", "none-any.whl lacks neuprim/report/page.html", marks=pytest.mark.slow
        ),
        ("pyproject.toml", 'include = ["neuprim*"]', 'include = ["neuprim*", "tests"]', "which is not the package's"),
        ("MANIFEST.in", "graft tests\n", "", ".tar.gz lacks tests/conftest.py"),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, old: str, new: str, message: str
) -> None:
    builder = script()
    checkout = tmp_path / "checkout"
    builder.copy_checkout(checkout)
    text = (checkout / file).read_text(encoding="utf-8")
    assert old in text
    (checkout / file).write_text(text.replace(old, new), encoding="utf-8")
    monkeypatch.setattr(builder, "ROOT", checkout)  # where there is no git
    with pytest.raises(SystemExit, match=message):
        builder.package(tmp_path / "dist")


def test_a_folder_that_exists_is_left_alone(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "expected the name of a folder that does not exist yet" in done.stderr
