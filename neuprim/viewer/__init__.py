"""Live viewer: render a model in this process and show the images in a browser page, after or during the training."""
