"""A model to look at in a browser, finished or while it is trained: pictures drawn here, sent to a page that turns,
plays and asks.

What is drawn, and when, knows nothing of the page: ``frame``, ``levels``, ``desk``, ``subject``, ``primitives``,
``path``. The page is viser's:
``gate`` and ``server`` let it in, ``session`` and the ``…_controls`` are what one open page shows.
"""
