"""The package in ``neuprim-spectral`` is a fixture; its own tests run where it is installed."""

collect_ignore = ["neuprim-spectral"]
