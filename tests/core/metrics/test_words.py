"""The line that says what a mean hides."""

from __future__ import annotations

import math
from typing import Any

from neuprim.core.metrics import metric_to_json
from neuprim.core.metrics.image import format_metrics


def metrics(values: list[float], bad: list[str]) -> dict[str, Any]:
    views = [{"name": f"v{i}", **metric_to_json("psnr", value)} for i, value in enumerate(values)]
    worst = min(range(len(values)), key=lambda i: values[i])
    return {
        "per_view": views,
        **metric_to_json("psnr_worst", values[worst]),
        "view_worst": f"v{worst}",
        "worse_than_black_image": bad,
    }


def test_the_worst_view_and_those_worse_than_black_are_named() -> None:
    found = format_metrics(metrics([40.0, 20.0, math.inf], ["v1"]))
    assert found == (
        "PSNR of 3 views, 1 exact: mean 30.00 dB, worst 20.00 dB (v1); worse than a black image: 1 of 3 (v1)"
    )
    assert format_metrics(metrics([40.0], [])) == "PSNR of 1 views: mean 40.00 dB, worst 40.00 dB (v0)"
    many = format_metrics(metrics([1.0] * 9, [f"v{i}" for i in range(9)]))
    assert many.endswith("(v0, v1, v2, v3, v4, v5 and 3 more, see worse_than_black_image in metrics.json)")
