"""What is said in several files about the project agrees: versions, extras, tools, citation, continuous integration."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

import neuprim
from tests.systems import posix

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def constraints() -> dict[str, str]:
    lines = [line.split("==") for line in text("constraints.txt").splitlines() if line and not line.startswith("#")]
    return {name.lower(): version for name, version in lines}


def test_the_version_is_written_once() -> None:
    assert "version" not in PROJECT["project"] and PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "neuprim.version.__version__"}
    assert metadata.version("neuprim") == neuprim.__version__
    assert re.search(r"^## (\S+)", text("CHANGELOG.md"), re.MULTILINE)[1] == neuprim.__version__  # type: ignore[index]


def test_every_requirement_has_a_constraint() -> None:
    wanted = itertools.chain(PROJECT["project"]["dependencies"], *EXTRAS.values())
    names = {re.split(r"[\[<>=;, ]", requirement)[0].lower() for requirement in wanted} - {"neuprim", "setuptools"}
    assert sorted(names - constraints().keys()) == []


def test_every_dependency_is_imported() -> None:
    """What another package needs, that package asks for."""
    modules = {"pillow": "PIL", "pyyaml": "yaml", "hydra-core": "hydra"}
    wanted = [Requirement(text) for text in PROJECT["project"]["dependencies"]]
    importing = re.compile(r"^\s*(?:import|from) (\w+)", re.MULTILINE)
    used = {name for file in (ROOT / "neuprim").rglob("*.py") for name in importing.findall(file.read_text("utf-8"))}
    assert [r.name for r in wanted if modules.get(r.name, r.name) not in used] == []


@posix
def test_the_script_is_one() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK) and script.read_bytes().startswith(b"#!/usr/bin/env bash\n")
    if shutil.which("bash") is None:
        pytest.skip("needs bash")
    subprocess.run(["bash", "-n", str(script)], check=True)
