"""Searches over trainings and renderings: trade-offs, target sizes, pruning and quantization.

``trials`` trains candidates, ``tradeoff_measuring`` measures them, ``tradeoff_record`` records them
and finds fronts.
``render_tradeoff`` and ``ablation`` compare finished runs and trained models; ``target`` searches a size; ``pruning``
and ``compress`` shrink a finished model.
"""
