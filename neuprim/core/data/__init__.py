"""What a data set hands to the trainer, and what loaders of posed images share."""

from neuprim.core.data.dataset import (
    Clip,
    Dataset,
    DataSource,
    Pixels,
    PointCloud,
    PointSamples,
    PointSupervision,
    StartingPoints,
    View,
    ViewSet,
    camera_extent,
)

__all__ = [
    "Clip",
    "DataSource",
    "Dataset",
    "Pixels",
    "PointCloud",
    "PointSamples",
    "PointSupervision",
    "StartingPoints",
    "View",
    "ViewSet",
    "camera_extent",
]
