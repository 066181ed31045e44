"""The engines that step a run: the kernel, highway-env's objects, lock step, and the environment itself."""
