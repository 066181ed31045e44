cimport cython
from libc cimport math

cdef int LANE_VALUES, SINE, CIRCULAR
cdef double LANE_ENDS, HALF_TURN

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

@cython.final
cdef class Features:
    cdef readonly Network network
    cdef readonly dict lanes
    cdef readonly double[::1] values
    cdef bint _has_destination, _has_place, _is_clipped
    cdef int[::1] _is_scaled
    cdef double[::1] _low, _high

    @cython.locals(values="double[::1]", heading=double, x=double, y=double, cos=double, sin=double, speed=double,
                   lane=int, angle=double)
    cdef void read(self, vehicle, bint is_object) except *

    @cython.locals(lane=int, dx=double, dy=double, away=double)
    cdef void _head_for_destination(self, vehicle, double x, double y) except *

    @cython.locals(values="double[::1]")
    cdef void subtract(self, double x, double y, double vx, double vy)

    @cython.locals(value=double, low=double)
    cdef double scaled(self, int feature) except? -1

@cython.final
cdef class Table:
    cdef Features _features
    cdef int[::1] _columns
    cdef Py_ssize_t _count
    cdef bint _is_relative, _sees_behind, _sees_intentions

    @cython.locals(features=Features, count=Py_ssize_t, table="float[:, ::1]", x=double, y=double, vx=double,
                   vy=double, row=Py_ssize_t, column=Py_ssize_t, index=Py_ssize_t)
    cpdef observe(self, ego, list vehicles, list objects, double reach, int exit_lane)

    @cython.locals(network=Network, lane=int, x=double, y=double, here=double, behind=double, count=Py_ssize_t,
                   index=Py_ssize_t, its_x=double, its_y=double, dx=double, dy=double, ahead=double, found=list)
    cdef list _nearest(self, ego, list vehicles, list objects, double reach)
