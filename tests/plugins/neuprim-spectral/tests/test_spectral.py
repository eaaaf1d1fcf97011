from neuprim_spectral import TASK

from neuprim.config import compose
from neuprim.conformance import checks
from neuprim.runs.open import read_metrics
from neuprim.runs.run import run


@checks(TASK)
def test_conforms(check):
    """All that neuprim relies on, one test per check; a failure says what was found and what was expected."""
    check()


def test_a_short_run_learns(tmp_path):
    small = "scene.size=16 scene.train_views=4 scene.test_views=1 model.primitives=30 renderer.backend=reference"
    found = []
    for steps in (1, 80):
        words = ["task=spectral", *small.split(), f"train.iterations={steps}", f"output_dir={tmp_path / str(steps)}"]
        found.append(read_metrics(run(compose(words)))["psnr"])
    assert found[1] > found[0] + 0.5
