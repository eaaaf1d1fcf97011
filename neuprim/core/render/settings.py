"""The settings of :mod:`neuprim.core.settings`, under the name that is documented."""

from neuprim.core.settings import BackendName, RenderSettings, SortOrder

__all__ = ["BackendName", "RenderSettings", "SortOrder"]
