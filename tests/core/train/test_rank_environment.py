"""The environment that torchrun makes, complete or not."""

from __future__ import annotations

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.train.process_group import TorchrunRank, read_torchrun_rank

COMPLETE = {
    "RANK": "3",
    "WORLD_SIZE": "4",
    "LOCAL_RANK": "1",
    "LOCAL_WORLD_SIZE": "2",
    "MASTER_ADDR": "host",
    "MASTER_PORT": "29500",
}
ALONE = {**COMPLETE, "RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"}


def test_a_rank_is_read() -> None:
    assert read_torchrun_rank(COMPLETE) == TorchrunRank(3, 4, 1, 2, "host:29500")


@pytest.mark.parametrize("environment", [{}, {"MASTER_ADDR": "host", "PATH": "/bin"}, ALONE])
def test_a_process_alone_has_none(environment: dict[str, str]) -> None:
    assert read_torchrun_rank(environment) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"RANK": None}, "MASTER_PORT without RANK; expected all of these variables .torchrun sets them., or none"),
        ({"MASTER_ADDR": ""}, "without MASTER_ADDR;"),
        ({"RANK": "x"}, "RANK=x: expected a whole number"),
        ({"LOCAL_RANK": "-1"}, "LOCAL_RANK=-1: expected a whole number"),
        ({"RANK": "4"}, "RANK=4; expected less than WORLD_SIZE=4"),
        ({"LOCAL_RANK": "2"}, "LOCAL_RANK=2; expected less than LOCAL_WORLD_SIZE=2"),
        ({"WORLD_SIZE": "0"}, "RANK=3; expected less than WORLD_SIZE=0"),
        ({"LOCAL_WORLD_SIZE": "9"}, "rank 3 of 4 is 1 of 9 on this machine"),
    ],
)
def test_an_incomplete_environment_is_refused(changes: dict[str, str | None], message: str) -> None:
    environment = {name: value for name, value in {**COMPLETE, **changes}.items() if value is not None}
    with pytest.raises(ConfigError, match=message):
        read_torchrun_rank(environment)
