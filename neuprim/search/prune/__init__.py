"""``neuprim prune``: a model without what its scene does not require.

``judge`` says how good a model is, ``cut`` which parts go, ``search`` how far it goes, ``run`` makes a run directory of
what is left.
"""
