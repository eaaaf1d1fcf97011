"""Read and write files: images, animations, PLY, OpenVDB and JSON; atomic writes."""
