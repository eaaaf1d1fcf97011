"""A model as one web page that draws it: no network, no server, exact in float32 by WebGL2.

``numbers`` packs the model's parameters, ``constants`` has what shaders take from the mathematics, ``page`` puts it all
into one file. What runs in the browser lies in ``assets``, a file per idea, and beside the fields, whose scripts
(:meth:`~neuprim.core.model.fields.Field.script`) fold time, light and view into closed forms as their Python does.
"""

from neuprim.webpage.page import Condition, PageView, WebPage, web_page

__all__ = ["Condition", "PageView", "WebPage", "web_page"]
