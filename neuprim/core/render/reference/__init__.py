"""The reference backend: plain torch in float64, with autograd."""
