"""What kernels need of the machine: how they are compiled and kept, and the threads that run them."""
