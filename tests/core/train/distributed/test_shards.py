"""Ranks that have a part of the primitives each train the whole model, bit for bit, and hold no more than their part of
it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.core import checkpoint
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, RankError
from neuprim.core.train.distributed import ALONE, pulse
from neuprim.core.train.distributed import group as groups
from neuprim.core.train.distributed.blocks import Blocks
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.distributed.refusals import refuse_parts
from neuprim.core.train.distributed.shards import Shards
from neuprim.core.train.settings import PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.runs.parts import read_part, write_parts
from tests.core import tiny
from tests.ranks import Killed, done, together
from tests.shards import different, share, whole_of

STEPS = 24
RELOCATE = {"strategy": "relocate", "fraction": 0.2, "grow_to": 17}


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return tiny.two_primitives(random_background=True)


def opaque() -> Dataset:
    """The same without alpha, so that exposures may be learned."""
    dataset = tiny.two_primitives()
    white = torch.ones(3)
    dataset.train.images = [replace(p, rgb=p.over(white), alpha=None) for p in dataset.train.images]  # type: ignore[attr-defined]
    return dataset


def close_up() -> Dataset:
    """Cameras that see one of the two and a little of the other."""
    dataset = tiny.two_primitives()
    for views in (dataset.train, dataset.test):
        views.cameras = [replace(c, cx=c.cx + 14.0) for c in views.cameras]  # type: ignore[attr-defined]
    return dataset


CASES: dict[str, tuple[int, int, Any, dict[str, Any]]] = {
    "fixed": (2, 1, tiny.two_primitives, {}),
    "births": (2, 1, tiny.two_primitives, {"population": RELOCATE}),
    "three ranks": (3, 2, tiny.two_primitives, {"population": RELOCATE, "warmup_steps": 5, "cooldown": 0.3}),
    "photographs": (2, 2, opaque, {"population": RELOCATE, "exposure_rate": 0.02, "angular_size": 0.1, "coarse": 2}),
    "close up": (2, 1, close_up, {"population": RELOCATE}),
}


@pytest.mark.parametrize("name", CASES)
def test_parts_are_the_whole(name: str) -> None:
    size, views, make, more = CASES[name]
    dataset = make()
    alone = tiny.trainer(dataset, STEPS, views_per_step=views * size, **more)
    expected = [(r.loss, r.parts, r.psnr, r.primitives, r.view, r.change) for r in alone.run()]
    assert ("population" in more) == any(change for *_, change in expected)

    def work(group: Group) -> tuple[Trainer, list[tuple[Any, ...]]]:
        trainer = share(tiny.trainer(dataset, STEPS, views_per_step=views, **more), group)
        return trainer, [(r.loss, r.parts, r.psnr, r.primitives, r.view, r.change) for r in trainer.run()]

    found = done(together(size, work))
    assert [reports for _, reports in found] == [expected] * size
    assert different(whole_of([trainer for trainer, _ in found]), alone.state()[0]) == []
    counts = [trainer.model.count for trainer, _ in found]
    assert sum(counts) == alone.model.count == found[0][0].count and max(counts) - min(counts) <= 1


def test_a_rank_holds_its_part_and_is_sent_what_its_view_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: dict[int, list[tuple[int, list[int]]]] = {0: [], 1: []}
    gather = Shards.gather

    def look(self: Shards, *given: Any) -> Any:
        drawn, sent = gather(self, *given)
        shown[self.rank].append((drawn.count, sent.give))
        return drawn, sent

    monkeypatch.setattr(Shards, "gather", look)
    dataset = close_up()

    def work(group: Group) -> tuple[int, int, list[int]]:
        trainer = share(tiny.trainer(dataset, STEPS), group)
        steps = []
        for _ in range(6):
            before = group.sent
            trainer.train_step()
            steps.append(group.sent - before)
        held = [*trainer.model.params.values(), *trainer.optimizer.m.values(), *trainer.optimizer.v.values()]
        held += [value if value.grad is None else value.grad for value in trainer.model.params.values()]
        return sum(value.nbytes for value in held), sum(value.numel() for value in trainer.model.params.values()), steps

    (bytes_0, numbers_0, sent_0), (bytes_1, numbers_1, _) = done(together(2, work))
    assert numbers_0 == numbers_1 == sum(v.numel() for v in tiny.trainer(dataset).model.params.values()) // 2
    assert bytes_0 == bytes_1 == 4 * 4 * numbers_0
    P = numbers_0 // 6
    for step, sent in enumerate(sent_0):
        (count, give), (other, given) = shown[0][step], shown[1][step]
        assert count == give[0] + given[0] < 12 and other == give[1] + given[1] < 12
        # rows of the other's view, gradients and tallies of the other's rows; counts and a letter
        assert sent == 4 * P * give[1] + 4 * (P + 2) * given[0] + 8 + 2048


def test_what_is_judged_is_drawn_with_everybodys_primitives(scene: Dataset) -> None:
    views = [scene.test.view(i % 2) for i in range(5)]

    def judge(place: int, model: Any) -> float:
        return float(place + model.params["means"].abs().sum().detach())

    def work(group: Group) -> list[float]:
        trainer = share(tiny.trainer(scene), group)
        return trainer.ranks.judged(trainer.model, views, judge)

    trainer = tiny.trainer(scene)
    expected = ALONE.judged(trainer.model, views, judge)
    assert done(together(2, work)) == [expected, expected]


def test_a_file_is_written_in_pieces_and_goes_on_with_any_number_of_ranks(
    scene: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six views a step: by three ranks with a part each, by one process, by two ranks with a part each; and by one
    process throughout."""
    monkeypatch.setattr("neuprim.core.train.distributed.shards._PIECE", 16)

    def make(views: int) -> Trainer:
        return tiny.trainer(scene, STEPS, population={**RELOCATE, "every": 5}, views_per_step=views)

    def part(views: int, size: int, file: Path, out: Path) -> None:
        def work(group: Group) -> None:
            trainer = share(make(views), group)
            if file.exists():
                header, tensors = read_part(file, "checkpoint", trainer.ranks)
                trainer.load_state(tensors, header, str(file))
            for _ in range(8):
                trainer.train_step()
            tensors, header = trainer.state()
            write_parts(out, "checkpoint", trainer, tensors, header)

        done(together(size, work))

    files = [tmp_path / f"{i}.safetensors" for i in range(4)]
    part(2, 3, files[0], files[1])
    middle = make(6)
    header, tensors = checkpoint.read(files[1], "checkpoint")
    middle.load_state(tensors, header, "file")
    assert middle.step == 8
    for _ in range(8):
        middle.train_step()
    checkpoint.write(files[2], "checkpoint", *middle.state())
    part(3, 2, files[2], files[3])
    whole = make(6)
    list(whole.run())
    header, tensors = checkpoint.read(files[3], "checkpoint")
    assert header["step"] == STEPS and different(tensors, whole.state()[0]) == []


def test_at_the_end_the_whole_model_takes_the_place_of_a_part(scene: Dataset) -> None:
    def work(group: Group) -> Trainer:
        trainer = share(tiny.trainer(scene), group)
        trainer.leave(tiny.trainer(scene).model.params)
        return trainer

    for trainer in done(together(2, work)):
        assert (
            trainer.ranks is ALONE and trainer.count == trainer.model.count == 12 and len(trainer.optimizer.age) == 12
        )


def test_a_rank_that_dies_is_named(scene: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("BEAT", 0.05), ("SILENCE", 1.0), ("LONG_SILENCE", 1.0)):
        monkeypatch.setattr(pulse, name, seconds)
    monkeypatch.setattr(groups, "LOOK", 0.02)

    def work(group: Group) -> None:
        trainer = share(tiny.trainer(scene), group)
        for _ in trainer.run():
            if group.rank == 1 and trainer.step == 4:
                raise Killed

    first, second = together(2, work)
    assert isinstance(second, Killed) and isinstance(first, RankError) and str(first) == "rank 1 died, in step 5"


@pytest.mark.parametrize(
    ("changes", "ranks", "message"),
    [
        ({}, 1, r"train\.shard=true: one process has all primitives; expected several, as torchrun --nproc-per-node 2"),
        ({"population": PopulationSettings(strategy="gradient")}, 2, r"strategy=gradient with train\.shard=true: .*; expected fixed or relocate"),
        ({"anisotropy_weight": 0.1}, 2, r"train\.anisotropy_weight=0\.1 with train\.shard=true: .*; expected 0"),
    ],
)  # fmt: skip
def test_what_cannot_be_in_parts_is_refused(changes: dict[str, Any], ranks: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        refuse_parts(TrainSettings(**changes), ranks)


def test_fewer_primitives_than_ranks_are_refused(scene: Dataset) -> None:
    for error in together(13, lambda group: share(tiny.trainer(scene), group)):
        assert isinstance(error, ConfigError) and "12 primitives for 13 ranks; expected one for each at least" in str(
            error
        )


@pytest.mark.parametrize(("count", "size"), [(7, 3), (12, 5), (4, 4), (1_000_003, 64)])
def test_blocks_follow_each_other(count: int, size: int) -> None:
    blocks = [Blocks(count, size).of(rank) for rank in range(size)]
    assert blocks[0][0] == 0 and blocks[-1][1] == count and all(a[1] == b[0] for a, b in itertools.pairwise(blocks))
    lengths = [stop - start for start, stop in blocks]
    assert max(lengths) - min(lengths) <= 1
