"""What only some operating systems have."""

from __future__ import annotations

import sys

import pytest

posix = pytest.mark.skipif(
    sys.platform == "win32", reason="needs POSIX: signals between processes, permissions, links or a shell"
)
