"""A model as one web page that draws it with WebGL2: exact in float32, without network and server.

What runs in the browser lies in ``assets`` and in the scripts of the fields, which fold time, light and view into
closed forms (:meth:`~neuprim.core.model.fields.Field.script`).
"""

from neuprim.webpage.model_page import Condition, PageScene, PageView, WebPage, make_model_webpage

__all__ = ["Condition", "PageScene", "PageView", "WebPage", "make_model_webpage"]
