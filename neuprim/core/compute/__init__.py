"""Infrastructure of kernels: compilation, the cache of compiled code, launches, devices and threads."""
