cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Box

@cython.locals(turn_a=double, turn_b=double)
cpdef bint overlap(Box a, Box b) except -1

@cython.locals(along=double, across=double, its_along=double, its_across=double)
cpdef double depth(Box a, Box b) except? -1

@cython.locals(cos_a=double, sin_a=double, turn=double, cos_t=double, sin_t=double, dx=double, dy=double,
               along=double, across=double)
cpdef (double, double) separation(Box a, Box b)
