"""Export a model as one HTML page that renders it with WebGL2: exact in float32, without a network or server.

The code for the browser is in ``assets`` and in the scripts of the fields, which evaluate time, light and view
direction in closed form (:meth:`~neuprim.core.model.fields.Field.script`).
"""

from neuprim.webpage.model_page import Condition, PageScene, PageView, WebPage, make_model_webpage

__all__ = ["Condition", "PageScene", "PageView", "WebPage", "make_model_webpage"]
