"""The family of primitives, as benchmarks name it, how many of each make equal bytes, and the scenes on which they are
compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from neuprim.config import Job, compose
from neuprim.core.train.settings import build_settings
from neuprim.runs.open import load_dataset


@dataclass(frozen=True)
class Form:
    """K cosines under an edge; ``gaussian`` is the baseline with none. A soft edge has a gain.

    ``source`` is what a volume is learned from, where it is not what its preset says.
    """

    neurons: int
    edge: int
    gaussian: bool = False
    source: str = ""

    @classmethod
    def named(cls, text: str) -> Form:
        """'K:EDGE', 'K:EDGE@images' or 'gaussian'."""
        if text == "gaussian":
            return cls(0, 0, True)
        form, _, source = text.partition("@")
        neurons, edge = form.split(":")
        return cls(int(neurons), int(edge), source=source)

    def __str__(self) -> str:
        name = "gaussian" if self.gaussian else f"{self.neurons}:{self.edge}"
        return f"{name}@{self.source}" if self.source else name

    @property
    def label(self) -> str:
        if self.gaussian:
            return "Gaussian"
        kind = "hard edge" if self.edge == 0 else f"soft edge p = {self.edge}, gain"
        paper = " (the paper's)" if (self.neurons, self.edge) == (PAPER.neurons, PAPER.edge) else ""
        return f"K = {self.neurons}, {kind}{paper}" + (f", {self.source} alone" if self.source else "")

    @property
    def words(self) -> tuple[str, ...]:
        """Settings of the model."""
        if self.gaussian:
            # of the rates 0.02, 0.1 and 0.2 the best: 23.63, 25.18, 25.37 dB on solids with 150 primitives
            return ("model.density.form=gaussian", "train.rates.log_amplitude=0.2")
        gain = f"model.density.gain={'true' if self.edge else 'false'}"
        source = (f"train.supervision={self.source}",) if self.source else ()
        return (f"model.neurons={self.neurons}", f"model.density.edge={self.edge}", gain, *source)

    def equal_bytes(self, primitives: int, task: str) -> int:
        """As many of these as have the parameters of ``primitives`` of the paper's form, all else equal."""
        return round(primitives * count_parameters(PAPER, task) / count_parameters(self, task))


PAPER = Form(8, 0)


@dataclass(frozen=True)
class Scene:
    """What forms are compared on.

    Attributes:
        words: of task, scene and what is done alike to all.
        folder: the setting that names the data, None for embedded scenes.
        judged: the metric that decides.
    """

    task: str
    words: tuple[str, ...]
    folder: str | None = None
    judged: str = "psnr"

    def all_words(self, folders: Mapping[str, Path], name: str) -> tuple[str, ...]:
        own = (f"{self.folder}='{folders[name].resolve()}'",) if self.folder else ()
        return (f"task={self.task}", *self.words, *own)


AS_RECORDED = ("train.population.grow_from=1", "train.cooldown=0")
"""How all presets trained when forms and populations were compared: all primitives there from the start, rates without
a cool-down. What is added to those records must train alike."""

_FIRE = ("scene=vdb", "scene.frames='1:40'", "scene.look=embergen_fire", "scene.size=96")
SCENES = {
    "solids": Scene("static", ("scene=solids", "scene.size=200", "train.background=white")),
    "chair": Scene("static", ("scene=blender", "train.background=white"), "scene.path"),
    "fire": Scene("dynamic", _FIRE, "scene.vdb", "psnr_mask"),
    "smoke_fire": Scene("dynamic", ("scene=smoke_fire", "scene.size=64"), judged="psnr_mask"),
    "lit_solids": Scene("relight", ("scene=lit_solids", "scene.size=128"), judged="psnr_linear_clamped"),
}
_SMALL = {
    "static": ("scene=solids", "scene.size=16"),
    "dynamic": ("scene=smoke_fire", "scene.size=8", "scene.resolution=16", "scene.timesteps=2"),
    "relight": ("scene=lit_solids", "scene.size=16"),
}


@cache
def count_parameters(form: Form, task: str) -> int:
    """Of one primitive of the task's preset, colour included."""
    config = compose([f"task={task}", *_SMALL[task], *form.words], check_output=False)
    job = Job.of(config)
    spec = job.task
    # without points: some forms learn more from voxels
    data = replace(load_dataset(job), points=None)
    density, colour = spec.build(build_settings(spec, config.model, config.options), data)
    geometry = 3 + 3 + 4
    return geometry + sum(parameter.size for parameter in (*density.parameters(), *colour.parameters()))
