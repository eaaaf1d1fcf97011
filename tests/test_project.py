"""What is said in several files about the project agrees: versions, extras, tools, citation, continuous integration."""

from __future__ import annotations

import ast
import itertools
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import neuprim
from tests.systems import posix

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
FOR_DEVELOPERS = {"test", "docs", "dev"}


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def parsed(name: str) -> Any:
    return yaml.safe_load(text(name))


def constraints() -> dict[str, str]:
    lines = [line.split("==") for line in text("constraints.txt").splitlines() if line and not line.startswith("#")]
    return {name.lower(): version for name, version in lines}


def test_the_version_is_written_once() -> None:
    assert "version" not in PROJECT["project"] and PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "neuprim.version.__version__"}
    assert metadata.version("neuprim") == neuprim.__version__
    assert re.search(r"^## (\S+)", text("CHANGELOG.md"), re.MULTILINE)[1] == neuprim.__version__  # type: ignore[index]


def test_the_extras_of_users_are_documented() -> None:
    (paragraph,) = [p for p in text("docs/getting_started.md").split("\n\n") if p.startswith("Extras:")]
    assert set(re.findall(r"neuprim\[(\w+)\]", paragraph)) == EXTRAS.keys() - FOR_DEVELOPERS


def test_every_requirement_has_a_constraint() -> None:
    wanted = itertools.chain(PROJECT["project"]["dependencies"], *EXTRAS.values())
    names = {re.split(r"[\[<>=;, ]", requirement)[0].lower() for requirement in wanted} - {"neuprim", "setuptools"}
    assert sorted(names - constraints().keys()) == []


def test_every_dependency_is_imported() -> None:
    """What another package needs, that package asks for."""
    modules = {"pillow": "PIL", "pyyaml": "yaml", "hydra-core": "hydra"}
    wanted = [Requirement(text) for text in PROJECT["project"]["dependencies"]]
    used: set[str] = set()
    for file in (ROOT / "neuprim").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                used |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                used.add(node.module.partition(".")[0])
    assert [r.name for r in wanted if modules.get(r.name, r.name) not in used] == []


@pytest.mark.parametrize(
    ("system", "machine", "has_wheel"),
    [
        ("linux", "x86_64", True),
        ("win32", "AMD64", True),
        ("darwin", "arm64", True),
        ("darwin", "x86_64", True),
        ("linux", "aarch64", False),
        ("win32", "ARM64", False),
    ],
)
def test_embree_is_asked_for_where_it_has_wheels(system: str, machine: str, has_wheel: bool) -> None:
    (embree,) = [r for r in map(Requirement, PROJECT["project"]["dependencies"]) if r.name == "embreex"]
    assert embree.marker is not None
    assert embree.marker.evaluate({"sys_platform": system, "platform_machine": machine}) == has_wheel


# ---------------------------------------------------------------- citation


def test_the_citation_is_complete() -> None:
    """The keys that the Citation File Format 1.2.0 requires, of the types that it requires."""
    citation = parsed("CITATION.cff")
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    assert {"message", "title", "authors"} <= citation.keys()
    assert citation["title"] == PROJECT["project"]["name"] and citation["license"] == PROJECT["project"]["license"]
    assert str(citation["version"]) == neuprim.__version__
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert paper["title"] == "Splat the Net: Radiance Fields with Splattable Neural Primitives"
    (identifier,) = paper["identifiers"]
    assert identifier["type"] in ("doi", "url", "swh", "other") and identifier["value"] == "arXiv:2510.08491"
    assert paper["url"] == "https://arxiv.org/abs/2510.08491" and paper["url"] in text("docs/index.md")
    for author in (*citation["authors"], *paper["authors"]):
        assert author.keys() <= {"name", "website"} and author["name"].strip()
    assert citation["authors"] == [{"name": "neuprim contributors"}]


# ---------------------------------------------------------------- tools


def test_pre_commit_has_the_tools_of_the_constraints() -> None:
    repositories = {entry["repo"].rpartition("/")[2]: entry for entry in parsed(".pre-commit-config.yaml")["repos"]}
    versions = constraints()
    assert repositories.keys() == {"ruff-pre-commit", "mirrors-mypy"}
    assert repositories["ruff-pre-commit"]["rev"] == f"v{versions['ruff']}"
    assert repositories["mirrors-mypy"]["rev"] == f"v{versions['mypy']}"
    assert [hook["id"] for hook in repositories["ruff-pre-commit"]["hooks"]] == ["ruff-check", "ruff-format"]
    (mypy,) = repositories["mirrors-mypy"]["hooks"]
    for pinned in mypy["additional_dependencies"]:
        name, version = pinned.split("==")
        assert versions[name] == version


# ---------------------------------------------------------------- continuous integration


def steps() -> list[tuple[str, list[str]]]:
    """(job, words) of every command of the workflow."""
    jobs = parsed(".github/workflows/ci.yml")["jobs"]
    runs = [(name, step["run"]) for name, job in jobs.items() for step in job["steps"] if "run" in step]
    return [(name, shlex.split(line)) for name, block in runs for line in block.splitlines() if line.strip()]


def test_the_workflow_s_commands_exist() -> None:
    commands = steps()
    assert ("everything", [".ci/run"]) in commands
    for job, words in commands:
        if job == "everything":
            continue
        assert words[:2] == ["python", "-m"], words
        assert words[2] in ("pip", "pytest", "neuprim"), words
        for path in (words[i + 1] for i, word in enumerate(words) if word == "-c"):
            assert (ROOT / path).is_file()
        for extra in itertools.chain(
            *(re.findall(r"\w+", group) for group in re.findall(r"\.\[([\w,]+)\]", " ".join(words)))
        ):
            assert extra in EXTRAS


def test_the_workflow_tests_as_the_readme_says() -> None:
    (line,) = [
        line for line in text("README.md").splitlines() if line.startswith("python3 -m venv") and "pytest" in line
    ]
    _, install, pytest_words = (shlex.split(part) for part in line.split("&&"))
    said = {tuple(words[2:]) for job, words in steps() if job == "tests"}
    assert ("pip", *(word for word in install[1:] if word != "-q")) in said
    assert ("pytest", *pytest_words[1:]) in said


def test_the_workflow_s_systems_and_versions() -> None:
    workflow = parsed(".github/workflows/ci.yml")
    triggers = workflow[True]  # what YAML 1.1 makes of the key "on"
    assert triggers.keys() == {"push", "pull_request"}
    matrix = workflow["jobs"]["tests"]["strategy"]["matrix"]
    assert set(matrix["os"]) == {"macos-latest", "windows-latest"}
    allowed = SpecifierSet(PROJECT["project"]["requires-python"])
    assert matrix["python"] == ["3.11", "3.12", "3.13"] and all(
        isinstance(v, str) and v in allowed for v in matrix["python"]
    )
    assert workflow["jobs"]["everything"]["runs-on"] == "ubuntu-latest"
    for job in workflow["jobs"].values():
        assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]) for step in job["steps"] if "uses" in step)
        assert job["timeout-minutes"] <= 60


def test_the_script_s_commands_are_in_the_readme() -> None:
    script = text(".ci/run")
    asked = re.findall(r"from_readme '?([^')]+)'?\)", script)
    assert sorted(asked) == ["neuprim run", "pytest"]
    commands = [line for line in text("README.md").splitlines() if line.startswith("python3 -m venv")]
    assert all(any(words in line for line in commands) for words in asked)
    assert " constraints.txt . " in next(line for line in commands if "neuprim run" in line), (
        "what it installs is replaced by the wheel"
    )


@posix
def test_the_script_is_one() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK) and script.read_bytes().startswith(b"#!/usr/bin/env bash\n")
    if shutil.which("bash") is None:
        pytest.skip("needs bash")
    subprocess.run(["bash", "-n", str(script)], check=True)
