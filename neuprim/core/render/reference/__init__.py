"""The oracle: plain torch in float64, with autograd."""
