"""Live viewer: shows a model in a browser, after or during its training.

The server draws images and sends them to a page made with viser. ``view`` starts a viewer, ``server`` and ``auth`` let
pages in, ``session`` is one open page.
"""
