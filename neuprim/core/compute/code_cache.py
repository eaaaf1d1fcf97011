"""Folders of compiled code that later processes run.

Whoever may write into such a folder, or replace it, decides what this user's processes execute. So it is used only if
this user owns it and nobody else may do either; otherwise code is kept in a folder of this process alone.
"""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import stat
import tempfile
from pathlib import Path

from neuprim.core.notices import warn_once


def code_cache(folder: Path) -> Path:
    """The folder, made where it is missing, or a private one with a warning if others may write it."""
    folder = folder.absolute()
    try:
        made = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if made:
            folder.chmod(0o700)  # whatever the umask is
        why = folder_weakness(folder)
    except OSError as error:
        why = f"cannot be used ({error.strerror or error})"
    if not why:
        return folder
    warn_once(
        f"{folder}: {why}; compiled code is not taken from there, and this process compiles its own. "
        "Expected a folder of yours alone"
    )
    return _private_code_folder()


def folder_weakness(folder: Path) -> str:
    """Return who else may change what a folder holds, in words; empty where nobody may, and on Windows."""
    if not hasattr(os, "getuid"):
        return ""
    own = os.getuid()
    whole = folder.resolve()
    for place in (whole, *whole.parents):
        there = place.stat()
        if there.st_uid != own and (place == whole or there.st_uid != 0):
            return f"belongs to user {there.st_uid}" if place == whole else f"{place} belongs to user {there.st_uid}"
        shared = there.st_mode & stat.S_IWOTH or (
            there.st_mode & stat.S_IWGRP and not _is_own_cache_group(there.st_gid, own)
        )
        if shared and (
            place == whole or not there.st_mode & stat.S_ISVTX
        ):  # others' entries of a sticky folder stay where they are
            return "others may write it" if place == whole else f"others may write {place}"
    return ""


def _is_own_cache_group(number: int, user: int) -> bool:
    """Whether a group is the user's own, as many systems make one of the same name for each, with nobody else in it."""
    import grp
    import pwd

    try:
        group, entry = grp.getgrgid(number), pwd.getpwuid(user)
    except KeyError:
        return False
    return entry.pw_gid == number and group.gr_name == entry.pw_name and not set(group.gr_mem) - {entry.pw_name}


@functools.cache
def _private_code_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="neuprim-code-")  # only this user enters it
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
