cimport cython
from libc cimport math
from pytest_pafot.world.kernel.bodies cimport Body

cdef double ALMOST

@cython.final
cdef class Lanes:
    cdef readonly int count
    cdef readonly double width, length
    cdef double _inside, _last, _left, _right

    @cython.locals(across=double, offset=double, lanes=double, lane=int)
    cpdef int locate(self, Body body) except -2

    @cython.locals(near=int, beyond=double, angle=double, best=double, lane=int, index=int, distance=double)
    cpdef int closest(self, double along, double across, double heading) except -1
