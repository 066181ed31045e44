"""The engines that simulate runs: in the kernel, with highway-env's objects, in lock step, or with ``env.step``."""
