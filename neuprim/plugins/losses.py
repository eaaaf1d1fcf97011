"""Built-in losses, which any task may use with ``train.loss=NAME``.

Built-in losses are registered like the losses of other packages.
"""

from __future__ import annotations

from neuprim.core.extensions import LossExtension
from neuprim.core.task import API_VERSION
from neuprim.core.train.losses import compressed_loss, l1, photometric, relative_loss

PHOTOMETRIC = LossExtension(
    API_VERSION,
    "photometric",
    "(1 - w) L1 + w (1 - SSIM), w = train.ssim_weight",
    photometric,
    uses=("train.ssim_weight",),
)
L1 = LossExtension(API_VERSION, "l1", "mean absolute difference", l1)
COMPRESSED = LossExtension(
    API_VERSION, "compressed", "L1 of log(1 + 16 x), for linear light: shadows count more", compressed_loss
)
RELATIVE = LossExtension(
    API_VERSION, "relative", "squared error over the squared rendered value, for linear light (RawNeRF)", relative_loss
)
