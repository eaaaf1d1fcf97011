"""Real processes of a real torchrun: what one process trains, a rank that is killed, and errors that are said once."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

import neuprim
from neuprim.config import compose
from neuprim.runs.fit import Event, Step
from neuprim.runs.run import run
from tests.core import tiny
from tests.short_runs import command_line, fit, words

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="torchrun's processes are found in /proc")
STEPS = 200


def torchrun(overrides: list[str], ranks: int = 2, **more: Any) -> subprocess.Popen[str]:
    """``neuprim run`` in that many processes."""
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc-per-node",
        str(ranks),
        "-m",
        "neuprim",
        "run",
        *command_line(overrides),
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(neuprim.__file__).parents[1])}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **more)


def rank(launched: subprocess.Popen[str], number: int) -> int:
    """Process id of a rank."""
    for child in Path(f"/proc/{launched.pid}/task/{launched.pid}/children").read_text().split():
        if f"RANK={number}\0".encode() in b"\0" + Path(f"/proc/{child}/environ").read_bytes().replace(
            b"LOCAL_RANK", b""
        ).replace(b"GROUP_RANK", b""):
            return int(child)
    raise AssertionError(f"no rank {number}")


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(text) for text in file.read_text().splitlines()] if file.exists() else []


def errors(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("neuprim: error")]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process with two views a step that nothing happens to."""
    return fit(
        words(scene, tmp_path_factory.mktemp("runs") / "whole", STEPS, "train.log_every=1", "train.views_per_step=2")
    )


def test_two_ranks_of_which_one_is_killed_then_one_process_then_two_ranks_are_one_process(
    scene: Path, whole: Path, tmp_path: Path
) -> None:
    """With as many views a step in all, every bit of the checkpoint is that of a run that nothing happened to, and so
    is its curve."""
    out = tmp_path / "out"
    of_two = words(scene, out, STEPS, "train.log_every=1")
    of_one = words(scene, out, STEPS, "train.log_every=1", "train.views_per_step=2")

    launched = torchrun(of_two)
    deadline = time.monotonic() + 200
    while len(lines(out / "metrics.jsonl")) < 20:
        assert time.monotonic() < deadline and launched.poll() is None, launched.communicate()
        time.sleep(0.01)
    os.kill(rank(launched, 1), signal.SIGKILL)
    killed = time.monotonic()
    _, said = launched.communicate(timeout=60)
    assert launched.returncode != 0 and time.monotonic() - killed < 20
    assert len(errors(said)) == 1, said
    (line,) = errors(said)
    found = re.match(
        r"neuprim: error: step (\d+): another rank ended without a message, .*; to continue: torchrun "
        r"--nproc-per-node 2 -m neuprim run .*resume=true$",
        line,
    )
    assert found is not None, line
    step = int(found[1])
    assert 20 < step <= STEPS - 40

    def interrupt(event: Event) -> None:
        if isinstance(event, Step) and event.report.step == step + 20:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(compose([*of_one, "resume=true"]), interrupt)
    assert [line["step"] for line in lines(out / "metrics.jsonl")] == list(range(1, step + 21)), (
        "no step is lost, none is there twice"
    )

    launched = torchrun([*of_two, "resume=true"])
    printed, said = launched.communicate(timeout=200)
    assert launched.returncode == 0, said
    assert (
        printed.startswith("PSNR ")
        and "\nnext: neuprim " in printed
        and said.count(f"resumed at step {step + 20}") == 1
        and said.count("measuring held-out views") == 1
    )

    first, second = (load_file(place / "checkpoint.safetensors") for place in (whole, out))
    assert first.keys() == second.keys()
    assert [name for name, value in first.items() if not torch.equal(value, second[name])] == []
    curves = [
        [{k: v for k, v in line.items() if k != "seconds"} for line in lines(place / "metrics.jsonl")]
        for place in (whole, out)
    ]
    assert curves[0] == curves[1] and len(curves[0]) == STEPS and any("change" in line for line in curves[0])
    metrics = [json.loads((place / "metrics.json").read_text()) for place in (whole, out)]
    assert metrics[0]["psnr"] == metrics[1]["psnr"] and (out / "report.html").exists()
