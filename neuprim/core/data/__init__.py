"""Data sets for training, and code that all loaders of posed images share."""

from neuprim.core.data.dataset import (
    Clip,
    Correction,
    Dataset,
    DatasetImages,
    DataSource,
    Pixels,
    PointCloud,
    PointSamples,
    PointSupervision,
    SceneContext,
    StartingPoints,
    View,
    ViewSet,
    camera_extent,
)

__all__ = ["Clip", "Correction", "DataSource", "Dataset", "DatasetImages", "Pixels", "PointCloud", "PointSamples"]
__all__ += ["PointSupervision", "SceneContext", "StartingPoints", "View", "ViewSet", "camera_extent"]
