"""What loaders of posed images share, whatever the task: files, settings, cameras, lazy views, and where matter is at the start."""
