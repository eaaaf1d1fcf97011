"""Every format that is read, spoiled in bytes and in structure: what comes is valid, or one line; within 4 GB and
seconds; nothing is written or contacted. ``python -m tests.fuzz.worker`` repeats a failure by its number.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fuzz.formats import FORMATS
from tests.fuzz.worker import KINDS, SECONDS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of address space are Linux's")

FEW, MANY = 40, 300
"""Files of each kind and format: by default, and in the slow tests."""

PACKAGES = {"colmap": "pycolmap", "colmap-text": "pycolmap", "cameras-usd": "pxr", "cameras-usdc": "pxr"}
"""Optional ones that formats need."""


class Reader:
    """A worker, started again when it dies."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.process = folder, None

    def find_faults(self, name: str, kind: str, count: int, seed: int) -> list[Any]:
        """What is wrong with the reading of so many spoiled files; all numbers of one that ends the worker are
        named."""
        if self.process is None or self.process.poll() is not None:
            root = Path(__file__).parents[2]
            paths = os.pathsep.join([str(root), *filter(None, sys.path)])
            env = os.environ | {"PYTHONPATH": paths, "TMPDIR": str(self.folder)}
            env |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            command = [sys.executable, "-m", "tests.fuzz.worker"]
            self.process = subprocess.Popen(command, env=env, text=True, **pipes)
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps([name, kind, 0, count, seed]) + "\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], 10 * SECONDS)
        line = self.process.stdout.readline() if ready else ""
        if not line:
            self.process.kill()
            last = next(iter(self.folder.glob("fuzz-*/now")), None)
            return [f"the worker {'died' if ready else 'hangs'} at {last.read_text() if last else 'its start'}"]
        return list(json.loads(line))


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    made = Reader(tmp_path_factory.mktemp("fuzz"))
    yield made
    if made.process is not None:
        made.process.kill()
        made.process.wait()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 11), marks=pytest.mark.slow)], ids=["few", "many"])
def test_spoiled_files_are_read_or_refused(seeds: range, name: str, kind: str, reader: Reader) -> None:
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name], reason=f"needs {PACKAGES[name]}")
    count = MANY // 10 if len(seeds) > 1 else FEW // 4 if FORMATS[name].slow else FEW
    for seed in seeds:  # in parts, so that a hanging one is noticed soon
        assert reader.find_faults(name, kind, count, seed) == []
