"""Searches over trainings and renderings: trade-offs, target sizes, pruning and quantization.

``trials`` trains candidates, ``measuring`` measures them, ``points`` records them, ``pareto`` finds fronts.
``render_tradeoff`` and ``ablation`` compare finished runs and trained models; ``target`` searches a size; ``pruning``
and ``compress`` shrink a finished model.
"""
