"""A test that hangs fails by name after a while, and does not hold up the rest; long files start first."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import FIRST, TESTS
from tests.systems import posix

ROOT = Path(__file__).parents[1]


def test_every_test_has_a_limit(pytestconfig: pytest.Config) -> None:
    assert 60 <= float(pytestconfig.getini("timeout")) <= 600


def test_the_files_that_start_first_exist() -> None:
    assert all((TESTS / name).is_file() for name in FIRST)


@posix  # elsewhere the whole process ends with the test
def test_a_hanging_test_fails_and_a_slow_one_may_go_on(tmp_path: Path) -> None:
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_waiting.py").write_text(
        "import time, pytest\n"
        "def test_hangs():\n    time.sleep(60)\n"
        "@pytest.mark.slow\ndef test_takes_its_time():\n    time.sleep(1.5)\n"
        "def test_is_quick():\n    pass\n"
    )
    limits = "-o timeout=1 -p no:cacheprovider -p no:xdist"
    words = ["-c", str(ROOT / "pyproject.toml"), "-m", "", *limits.split(), str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words], capture_output=True, text=True, cwd=tmp_path, check=False, timeout=50
    )
    assert "1 failed, 2 passed" in done.stdout, done.stdout
    assert "test_hangs" in done.stdout and "Timeout" in done.stdout
