"""What steps a run: the kernel, highway-env's objects, lock step, the environment itself."""
