"""A run's report: one HTML page that stands alone, with pictures, curves, numbers and settings.

:func:`write_report` reads a run directory, finished or interrupted, and writes ``report.html`` into it.
:func:`error_map` colours the error of a rendered view on the fixed scale that the page's colour bar shows.
"""

from neuprim.report.pictures import ERROR_SCALE, error_map
from neuprim.report.run_report import Viewer, write_report

__all__ = ["ERROR_SCALE", "Viewer", "error_map", "write_report"]
