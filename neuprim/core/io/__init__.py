"""Files: images, films, PLY, OpenVDB and JSON, and atomic writes."""
