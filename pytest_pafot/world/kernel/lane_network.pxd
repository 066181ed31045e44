cimport cython
from libc cimport math
from pytest_pafot.world.kernel.driver cimport clamp, wrap_angle

cdef int LANE_VALUES, SINE, CIRCULAR
cdef double LANE_ENDS

@cython.final
cdef class Network:
    cdef readonly int count
    cdef readonly double along, across, x, y
    cdef readonly int[::1] numbers
    cdef readonly double[::1] lengths, speed_limits
    cdef tuple _given
    cdef int[::1] _kinds, _sections, _forbidden
    cdef double[::1] _shapes, _widths

    cpdef bint is_beside(self, int lane, int other) except -1

    @cython.locals(row=Py_ssize_t, kind=int)
    cpdef locate(self, int lane, double x, double y)

    @cython.locals(row=Py_ssize_t, kind=int)
    cpdef position(self, int lane, double along, double across)

    cdef double _sideways(self, Py_ssize_t row) except? -1

    @cython.locals(row=Py_ssize_t, kind=int)
    cpdef double heading_at(self, int lane, double along) except? -1

    @cython.locals(nearest=int, lane=int)
    cpdef int closest(self, double x, double y, double heading) except -1

    @cython.locals(inside=bint)
    cpdef bint is_on(self, int lane, double x, double y, double margin) except -1

    @cython.locals(inside=bint)
    cpdef bint is_reachable(self, int lane, double x, double y) except -1

    cpdef bint is_after_end(self, int lane, double x, double y) except -1

@cython.final
cdef class Table:
    cdef Network _network
    cdef dict _lanes
    cdef double[::1] _values, _low, _high
    cdef int[::1] _columns, _is_scaled
    cdef Py_ssize_t _count
    cdef bint _has_destination, _has_place, _is_clipped, _is_relative, _sees_behind, _sees_intentions

    @cython.locals(count=Py_ssize_t, table="float[:, ::1]", row=Py_ssize_t, column=Py_ssize_t, index=Py_ssize_t)
    cpdef observe(self, ego, list vehicles, list objects, double reach, int exit_lane)

    @cython.locals(lane=int, x=double, y=double, count=Py_ssize_t, index=Py_ssize_t, its_x=double, its_y=double)
    cdef list _nearest(self, ego, list vehicles, list objects, double reach)

    @cython.locals(heading=double, x=double, y=double, speed=double, lane=int)
    cdef void _read(self, vehicle, bint is_object) except *

    @cython.locals(lane=int)
    cdef void _head_for_destination(self, vehicle, double x, double y) except *

    cdef double _scaled(self, int feature) except? -1
