"""The environment that torchrun makes, whole or not."""

from __future__ import annotations

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.train.distributed.place import Place, place_of

WHOLE = {
    "RANK": "3",
    "WORLD_SIZE": "4",
    "LOCAL_RANK": "1",
    "LOCAL_WORLD_SIZE": "2",
    "MASTER_ADDR": "host",
    "MASTER_PORT": "29500",
}


def test_a_place() -> None:
    place = place_of(WHOLE)
    assert place == Place(3, 4, 1, 2, "host:29500") and place.local_first == 2


@pytest.mark.parametrize("environment", [{}, {"MASTER_ADDR": "host", "PATH": "/bin"}])
def test_nobody_launched_several(environment: dict[str, str]) -> None:
    assert place_of(environment) is None


def test_one_process_of_torchrun_is_a_process_alone() -> None:
    assert place_of({**WHOLE, "RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"}) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"RANK": None},
            r"WORLD_SIZE, LOCAL_RANK, LOCAL_WORLD_SIZE, MASTER_ADDR, MASTER_PORT without RANK; expected all that torchrun sets, or none",
        ),
        ({"MASTER_ADDR": ""}, "without MASTER_ADDR;"),
        ({"RANK": "x"}, "RANK=x: expected a whole number"),
        ({"LOCAL_RANK": "-1"}, "LOCAL_RANK=-1: expected a whole number"),
        ({"RANK": "4"}, "RANK=4 with WORLD_SIZE=4: expected less"),
        ({"LOCAL_RANK": "2"}, "LOCAL_RANK=2 with LOCAL_WORLD_SIZE=2: expected less"),
        ({"WORLD_SIZE": "0"}, "RANK=3 with WORLD_SIZE=0"),
        ({"LOCAL_WORLD_SIZE": "9"}, "rank 3 of 4 is 1 of 9 on this machine"),
    ],
)
def test_half_an_environment_is_refused(changes: dict[str, str | None], message: str) -> None:
    environment = {name: value for name, value in {**WHOLE, **changes}.items() if value is not None}
    with pytest.raises(ConfigError, match=message):
        place_of(environment)
