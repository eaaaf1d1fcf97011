"""What users and disks do to volume scenes: wrong optics, unusual grids, damaged and shared caches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.vdb import write_vdb
from neuprim.tasks.dynamic.volume.looks import changed, named_look
from tests.tasks.dynamic.test_volume_scene import blob


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames with density, temperature and flames."""
    made = tmp_path / "files"
    made.mkdir()
    for number in (1, 2):
        write_vdb(made / f"ball_{number}.vdb", blob(10.0 + number, ("density", "temperature", "flames")))
    return made


# ---------------------------------------------------------------- optics


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("albedo", 0.5, r"scene\.optics\.albedo=0\.5: expected three numbers"),
        ("albedo", [1, 2], r"scene\.optics\.albedo=\[1, 2\]: expected three numbers"),
        ("albedo", [1, 2, True], r"expected three numbers"),
        ("kelvin", [1000, 2000, 3000], r"scene\.optics\.kelvin=.*: expected two numbers"),
        ("kelvin", [2000, 1000], r"scene\.optics\.kelvin=.*rising"),
        ("flame_range", [0], r"scene\.optics\.flame_range=\[0\]: expected two numbers"),
        ("extinction", None, r"scene\.optics\.extinction=None: expected a number"),
        ("extinction", float("nan"), r"expected a number"),
        ("gradient", [], r"scene\.optics\.gradient=\[\]: expected colours"),
        ("gradient", [1, 2], r"scene\.optics\.gradient=1: expected three numbers"),
        ("light", "sun", r"scene\.optics\.light=sun: expected scene\.optics\.light\.direction"),
        ("light", {"colour": [1, 1, 1]}, r"expected scene\.optics\.light\.direction"),
        ("light", {"direction": [0, 0, 0]}, r"scene\.optics\.light\.direction=\[0, 0, 0\]: expected numbers that are not all 0"),
        ("light", {"direction": [0, 1]}, r"scene\.optics\.light\.direction=\[0, 1\]: expected three numbers"),
        ("light", {"irradiance": [-1, 0, 0]}, r"scene\.optics\.light=.*negative"),
        ("flame_grid", "fire", r"scene\.optics\.flame_grid=fire: expected density or temperature or flames or color"),
        ("extinction_grids", "density", r"scene\.optics\.extinction_grids=density: expected a list"),
        ("up", "x", r"scene\.optics\.up=x: expected y or z"),
    ],
)
def test_wrong_optics_name_key_found_and_expected(key: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        changed(named_look("smoke_fire"), {key: value})


def test_optics_of_every_form() -> None:
    look = changed(
        named_look("smoke_fire"),
        {"extinction": 3, "albedo": [1, 0.5, 0], "gradient": [[1, 0, 0], [0, 0, 1]], "light": {"irradiance": [1, 2, 3]}},
    )
    assert look.extinction == 3 and look.albedo == (1.0, 0.5, 0.0) and look.gradient == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert look.light is not None and look.light.irradiance == (1.0, 2.0, 3.0)
    original = named_look("smoke_fire").light
    assert original is not None and look.light.direction == original.direction
    assert changed(look, {"light": None}).light is None
    with pytest.raises(ConfigError, match=r"scene\.optics\.light\.irradiance: required .* the look has no light"):
        changed(named_look("embergen_fire"), {"light": {"direction": [0, 0, 1]}})
