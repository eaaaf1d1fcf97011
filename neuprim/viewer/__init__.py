"""Live viewer: shows a model in a browser, after or during its training; drawn here, in a page made with viser."""
