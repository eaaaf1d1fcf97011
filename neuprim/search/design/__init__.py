"""What the knobs of a model cost: a designed set of trainings, measured side by side, and the fronts of what is best.

:func:`~neuprim.search.design.run.design_run` trains, measures and writes; every model is a trial
(:mod:`neuprim.search.trials`), and every point on a front has the words that train it.
"""
