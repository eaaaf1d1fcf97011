"""Compiled code is kept, and taken, only where nobody else may write."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from neuprim.core import errors
from neuprim.core.compute.kernels import cache_directory, code_cache, folder_weakness
from neuprim.core.errors import NeuprimWarning
from tests.systems import posix


@posix
def test_a_folder_of_ones_own_is_taken_and_made_private(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        assert code_cache(tmp_path / "own") == tmp_path / "own"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "own").stat().st_mode) == 0o700 and not folder_weakness(tmp_path / "own")


@posix
@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o757])
def test_a_folder_that_others_may_write_is_not(tmp_path: Path, mode: int, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "shared"
    place.mkdir()
    place.chmod(mode)
    monkeypatch.setattr(errors, "_said", set())
    with pytest.warns(
        NeuprimWarning, match=r"shared: other users may write to it; compiled code in this folder is not trusted"
    ):
        private = code_cache(place)
    assert private != place and stat.S_IMODE(private.stat().st_mode) == 0o700
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(place))
    assert cache_directory() == private and not any(place.iterdir())


@posix
def test_who_may_replace_the_folder_counts_too(tmp_path: Path) -> None:
    place = tmp_path / "open" / "own"
    place.mkdir(parents=True, mode=0o700)
    (tmp_path / "open").chmod(0o777)
    assert folder_weakness(place) == f"other users may write to {tmp_path / 'open'}"
    (tmp_path / "open").chmod(0o1777)  # as /tmp: nobody moves what is not theirs
    assert not folder_weakness(place)
    (tmp_path / "link").symlink_to(place)
    (tmp_path / "open").chmod(0o777)
    assert folder_weakness(tmp_path / "link"), "where the link leads to"


@posix
def test_a_folder_of_somebody_else_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert folder_weakness(tmp_path) == f"belongs to user {tmp_path.stat().st_uid}"
