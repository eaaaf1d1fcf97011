"""Files: images, films, PLY, OpenVDB, and writing them so that nothing is half there."""
