"""The relighting task: images under one point light each. So far its data: loaders, a built-in scene and measures.

``olat`` reads the layout of GS³ and NRHints, ``lit`` draws the built-in scene in that layout, ``data`` is the data set both make,
``measure`` its measures.
"""
