"""Live viewer: render a model in the Python process and show the images in a browser, after or during training."""
