"""Searches over trainings and render settings: trade-offs, model sizes for a target, pruning and quantization.

``trials`` trains candidates, ``tradeoff_measuring`` measures them, ``tradeoff_record`` finds Pareto fronts.
``render_tradeoff`` varies render settings and ``ablation`` training settings. ``target`` searches the size of a model.
``pruning`` and ``compress`` make a finished model smaller.
"""
