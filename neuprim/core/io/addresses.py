"""Pictures as ``data:`` addresses, for pages that hold everything."""

from __future__ import annotations

import base64
import io

from PIL import Image
from torch import Tensor

from neuprim.core.io.images import to_uint8

__all__ = ["picture_address"]


def picture_address(image: Tensor, widest: int, quality: int = 85) -> str:
    """An image (H, W, 3) of sRGB values 0..1 as WebP, made smaller where it is wider than ``widest`` pixels."""
    picture = Image.fromarray(to_uint8(image).numpy())
    if picture.width > widest:
        picture = picture.resize(
            (widest, max(1, round(picture.height * widest / picture.width))), Image.Resampling.LANCZOS
        )
    file = io.BytesIO()
    picture.save(file, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
