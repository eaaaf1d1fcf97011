"""Export a model as one HTML page that renders it with WebGL2: exact in float32, without a network or server.

The browser code is in the folder ``assets``, and in the scripts of density and colour fields. The scripts evaluate a
field in closed form for any time, light and view direction (:meth:`~neuprim.core.model.fields.Field.script`).
"""

from neuprim.webpage.model_page import Condition, PageScene, PageView, WebPage, make_model_webpage

__all__ = ["Condition", "PageScene", "PageView", "WebPage", "make_model_webpage"]
