"""What models of moving scenes are judged by where a volume sequence was recorded: masks, films, and the files' own
extinction.

Of other data sets, images with a time each, nothing is known that is not in the images. What reads volumes is imported
when used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from neuprim.core.data import Clip, Dataset
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.model.primitives import Primitives

if TYPE_CHECKING:
    from neuprim.tasks.dynamic.volume.dataset import Recording

__all__ = ["clips", "diagnose", "mask", "recording_of"]


def recording_of(dataset: Dataset) -> Recording | None:
    """The volume sequence that the images were rendered from; None where there is none.

    Raises:
        DatasetFault: the data set's ``extra`` is something else.
    """
    if dataset.extra is None:
        return None
    from neuprim.tasks.dynamic.volume.dataset import Recording

    return get_extra(dataset, Recording)


def mask(dataset: Dataset, index: int) -> Tensor | None:
    """Pixels that show matter in some frame of the view's camera."""
    recording = recording_of(dataset)
    return None if recording is None else recording.track(index)


def clips(dataset: Dataset) -> Sequence[Clip]:
    """Every held-out camera's frames."""
    recording = recording_of(dataset)
    if recording is None:
        return ()
    frames = len(recording.capture.frames)
    return [
        Clip(f"cam_{c:02d}", range(i * frames, (i + 1) * frames), 24.0) for i, c in enumerate(recording.test.cameras)
    ]


def diagnose(dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """The model's extinction against the files', and its size against theirs."""
    recording = recording_of(dataset)
    if recording is None:
        return {}
    from neuprim.tasks.dynamic.invisible import invisible_fraction
    from neuprim.tasks.dynamic.volume.compare import compare_with_truth

    capture, times = recording.capture, recording.test.times
    return {
        "exposure": dataset.exposure,
        "vdb_bytes": sum(frame.path.stat().st_size for frame in capture.frames),
        "normalisation": capture.normalisation.to_json(),
        "invisible_fraction": invisible_fraction(model, times),
        **compare_with_truth(model, capture, [float(t) for t in times]),
    }
