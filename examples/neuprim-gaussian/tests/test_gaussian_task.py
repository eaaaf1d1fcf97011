"""Everything neuprim asks of a task, and what only this one promises."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from neuprim_gaussian import TASK
from neuprim_gaussian.density import bell

from neuprim.config import compose
from neuprim.conformance import checks
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.open import read_metrics
from neuprim.runs.run import run

SMALL = (
    "scene.size=16 scene.train_views=4 scene.test_views=1 scene.supersampling=1 model.primitives=40 model.sh_degree=0"
)


@checks(TASK)
def test_conforms(check: Callable[[], None]) -> None:
    check()


@checks(TASK, model={"density": {"deviations": 1.0}, "sh_degree": 0})
def test_conforms_with_a_hard_edge(check: Callable[[], None]) -> None:
    check()


def test_the_integral_keeps_its_digits() -> None:
    """Against Gauss-Legendre quadrature, relative to the integral itself: around 0, in the tails, on short
    intervals."""
    x, weights = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(100))
    z, w = torch.meshgrid(
        torch.linspace(-6, 6, 49, dtype=torch.float64), torch.logspace(-9, 0.3, 60, dtype=torch.float64), indexing="ij"
    )
    exact = (-((z[..., None] + w[..., None] * x) ** 2)).exp() @ weights * w
    assert float((bell(z, w) / exact - 1).abs().max()) < 1e-10


def test_gradients_of_the_integral() -> None:
    z = torch.tensor([0.0, 0.5, -3.0, 2.0, 0.1], dtype=torch.float64, requires_grad=True)
    w = torch.tensor([1.0, 0.6, 0.5, 0.004, 0.002], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(bell, [z, w], atol=1e-8)


def test_a_short_run_learns(tmp_path: Path) -> None:
    found = []
    for steps in (1, 40):
        words = ["task=gaussian", *SMALL.split(), f"train.iterations={steps}", f"output_dir={tmp_path / str(steps)}"]
        found.append(read_metrics(run(compose(words)))["psnr"])
    assert found[1] > found[0] + 1


def test_wrong_settings_are_refused_before_data_are_loaded() -> None:
    with pytest.raises(ConfigError, match=r"model.density.deviations: 20.0 standard deviations; expected 0.5 to 10"):
        compose(["task=gaussian", "model.density.deviations=20.0"])
    with pytest.raises(ConfigError, match=r"did you mean 'model\.density\.deviations'"):
        compose(["task=gaussian", "+model.density.deviation=2"])


def test_the_fast_backend_says_why_it_cannot(tmp_path: Path) -> None:
    with pytest.raises(BackendUnavailable, match="cannot draw CustomDensity density"):
        run(
            compose(
                [
                    "task=gaussian",
                    *SMALL.split(),
                    "renderer.backend=cpu",
                    "train.iterations=1",
                    f"output_dir={tmp_path / 'r'}",
                ]
            )
        )
