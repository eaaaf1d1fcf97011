"""Tests lie where the code does: whoever changes a folder of the package finds its tests in the folder of the same
name."""

from __future__ import annotations

from pathlib import Path

import neuprim

TESTS, PACKAGE = Path(__file__).parent, Path(neuprim.__file__).parent
OTHERS = {"docs", "fuzz", "numerics"}
"""Folders of tests without one of the package: the documentation, and what all renderers must agree on."""


def folders(tests: Path, package: Path) -> list[str]:
    """Folders with tests that no folder of the package has the name of."""
    found = {file.parent.relative_to(tests) for file in tests.rglob("test_*.py")} - {Path()}
    return sorted(
        f.as_posix()
        for f in found
        if f.parts[0] not in OTHERS and not any("-" in p for p in f.parts) and not (package / f).is_dir()
    )


def misplaced(tests: Path, package: Path) -> list[str]:
    """Tests named after a room that lie beside the folder of its tests."""
    found = [file.relative_to(tests) for room in (tests, tests / "core") for file in room.glob("test_*.py")]
    return sorted(
        f.as_posix() for f in found if (package / f.parent / f.stem.removeprefix("test_") / "__init__.py").exists()
    )


def test_no_two_files_of_tests_have_one_name() -> None:
    """Folders of tests are no packages, so that the second of a name could not be collected."""
    names = [f.name for f in TESTS.rglob("test_*.py") if not any("-" in part for part in f.relative_to(TESTS).parts)]
    assert sorted(name for name in set(names) if names.count(name) > 1) == []


def test_every_folder_of_tests_is_one_of_the_package() -> None:
    assert folders(TESTS, PACKAGE) == []
    assert all((TESTS / name).is_dir() and not (PACKAGE / name).exists() for name in OTHERS)


def test_tests_of_a_room_are_in_its_own_folder() -> None:
    assert misplaced(TESTS, PACKAGE) == []


def test_both_are_noticed(tmp_path: Path) -> None:
    for place in (
        "package/core/io/__init__.py",
        "tests/core/test_io.py",
        "tests/gone/test_x.py",
        "tests/docs/test_y.py",
    ):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    assert folders(tmp_path / "tests", tmp_path / "package") == ["gone"]
    assert misplaced(tmp_path / "tests", tmp_path / "package") == ["core/test_io.py"]
