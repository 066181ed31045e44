cimport cython
from libc cimport math

cdef double MAX_SPEED

cdef class Box:
    cdef public double x, y, heading, length, width

cdef class Body(Box):
    cdef public double speed, acceleration, steering
    cdef public int lane

    cpdef void place(self, double x, double y, double heading, double speed)

    @cython.locals(speed=double, course=double, slip=double)
    cpdef void step(self, double dt)

@cython.locals(turn_a=double, turn_b=double)
cpdef bint overlap(Box a, Box b) except -1

@cython.locals(along=double, across=double, its_along=double, its_across=double)
cpdef double depth(Box a, Box b) except? -1

@cython.locals(cos_a=double, sin_a=double, turn=double, cos_t=double, sin_t=double, dx=double, dy=double,
               along=double, across=double)
cpdef (double, double) separation(Box a, Box b)
