cimport cython
from libc cimport math

cdef int LANE_VALUES, SINE, CIRCULAR
cdef double LANE_ENDS

@cython.final
cdef class Network:
    cdef readonly int count
    cdef readonly double along, across, x, y
    cdef int[::1] _kinds, _sections, _numbers, _forbidden
    cdef double[::1] _shapes, _lengths, _widths, _speed_limits

    cpdef double length(self, int lane) except? -1
    cpdef double width(self, int lane) except? -1
    cpdef double speed_limit(self, int lane) except? -1
    cpdef int number(self, int lane) except -1
    cpdef bint is_beside(self, int lane, int other) except -1

    @cython.locals(row=Py_ssize_t, kind=int, dx=double, dy=double, radius=double, start=double, turn=double, phi=double,
                   cos=double, sin=double)
    cpdef locate(self, int lane, double x, double y)

    @cython.locals(row=Py_ssize_t, kind=int, radius=double, start=double, turn=double, phi=double, cos=double,
                   sin=double)
    cpdef position(self, int lane, double along, double across)

    cdef double _sideways(self, Py_ssize_t row) except? -1

    @cython.locals(row=Py_ssize_t, kind=int, turn=double, heading=double, amplitude=double, pulsation=double)
    cpdef double heading_at(self, int lane, double along) except? -1

    @cython.locals(best=double, nearest=int, lane=int, along=double, length=double, distance=double)
    cpdef int closest(self, double x, double y, double heading) except -1

    @cython.locals(inside=bint)
    cpdef bint is_on(self, int lane, double x, double y, double margin) except -1

    @cython.locals(inside=bint)
    cpdef bint is_reachable(self, int lane, double x, double y) except -1

    cpdef bint is_after_end(self, int lane, double x, double y) except -1

cpdef double wrapped(double angle) except? -1e300
