from libc cimport math

cdef double MAX_SPEED

cdef class Box:
    cdef public double x, y, heading, length, width

cdef class Body(Box):
    cdef public double speed, acceleration, steering
    cdef public int lane

    cpdef void place(self, double x, double y, double heading, double speed)

    cpdef void step(self, double dt)

cpdef bint overlap(Box a, Box b) except -1

cpdef double depth(Box a, Box b) except? -1

cpdef (double, double) separation(Box a, Box b)
