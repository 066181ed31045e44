cimport cython
from libc cimport math

cdef double STEP, HALF_TURN, ON_LANE

@cython.locals(below=Py_ssize_t, rest=double)
cpdef Py_ssize_t even_rounded(double exact) except? -1

@cython.final
cdef class Bends:
    cdef readonly double along, across, angle, offset
    cdef readonly int lane
    cdef double[::1] _x, _y, _heading, _across, _direction, _lean, _speed, _sharpest, _widths
    cdef int[::1] _exists, _part
    cdef Py_ssize_t _points
    cdef int _lanes
    cdef double _end, _lane_width, _share, _x0, _y0, _direction0

    cpdef Py_ssize_t point(self, double along) except -1

    cpdef bint exists(self, int lane, double along) except -1

    @cython.locals(row=Py_ssize_t, index=Py_ssize_t)
    cpdef bint continues(self, int lane, double since, double until) except -1

    @cython.locals(index=Py_ssize_t)
    cdef Py_ssize_t _between(self, double along) except -1

    @cython.locals(index=Py_ssize_t, share=double)
    cdef double _value(self, double[::1] values, int lane, double along) except? -1

    cpdef double across_at(self, int lane, double along) except? -1

    cpdef double direction_at(self, int lane, double along) except? -1

    cpdef double lean_at(self, int lane, double along) except? -1

    cpdef double sharpest_at(self, int lane, double along) except? -1

    cpdef double x_at(self, double along) except? -1

    cpdef double y_at(self, double along) except? -1

    cpdef double heading_at(self, double along) except? -1

    cpdef double speed_at(self, int lane, double along) except? -1

    @cython.locals(index=Py_ssize_t, bend=double)
    cpdef double stretch(self, double along, double across) except? -1

    @cython.locals(index=Py_ssize_t, share=double, turned=double)
    cdef void _refer(self, double along) except *

    @cython.locals(along=double, cos=double, sin=double, ahead=double, across=double, point=Py_ssize_t, nearest=int,
                   best=double, lane=int, index=Py_ssize_t)
    cpdef void locate(self, double x, double y, double heading, double near) except *

    @cython.locals(toward=int, scale=double, apart=double)
    cpdef double in_lanes(self, int lane, double along, double offset) except? -1

    @cython.locals(part=int)
    cpdef int part(self, int lane, double along, double offset) except -2

    @cython.locals(nearest=int)
    cpdef int nearest_lane(self, double lateral) except -2
