"""Absolute differences and the angle between spectra, of the pixels that count; views that are shifted more count
less."""


def spectral_loss(weight):
    """(1 - w) mean |d| + w mean (1 - cos angle) over the pixels of the mask, divided by 1 + the view's shift."""

    def loss(rendered, truth, frame):
        if frame.mask is not None:
            rendered, truth = rendered[frame.mask], truth[frame.mask]
        absolute = (rendered - truth).abs().mean()
        cosine = (rendered * truth).sum(-1) / (rendered.norm(dim=-1) * truth.norm(dim=-1)).clamp_min(1e-3)
        angle = (1 - cosine).mean()
        shift = float(frame.view.conditions.get("wavelength_shift", 0.0))
        value = ((1 - weight) * absolute + weight * angle) / (1 + shift)
        return value, {"absolute": absolute.item(), "angle": angle.item()}

    return loss
