"""What speed costs in accuracy, of a finished run: every knob of drawing turned alone, then together, and the front of
what is best.

:func:`~neuprim.search.tradeoff.run.tradeoff_run` measures and writes; points are those of :mod:`neuprim.runs.render_config`,
in words to paste.
"""
