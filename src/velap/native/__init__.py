"""Float32 kernels in C for planning on a CPU."""
