cimport cython
from libc cimport math
from pytest_pafot.world.kernel.lane_network cimport Network

cdef int ON_ROAD
cdef double LANE_REACH, SLOWEST, HALF_TURN

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

    @cython.locals(value=double, low=double)
    cdef double rounded(self, int feature) except? -1

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

@cython.final
cdef class Grid:
    cdef Features _features
    cdef int[::1] _layers
    cdef bint _is_turned
    cdef double _left, _top, _step_x, _step_y, _cos, _sin

    @cython.locals(features=Features, values="double[::1]", x=double, y=double, vx=double, vy=double,
                   index=Py_ssize_t, at_x=double, at_y=double, layer=Py_ssize_t)
    cpdef void fill(self, double[:, :, ::1] grid, ego, list vehicles) except *

    @cython.locals(right=double, down=double, row=Py_ssize_t, column=Py_ssize_t)
    cdef void _mark(self, double[:, :, ::1] grid, Py_ssize_t layer, double x, double y, double value) except *

    @cython.locals(network=Network, spacing=double, lane=int, first=double, length=double, before=double, step=double,
                   index=Py_ssize_t, along=double)
    cdef void _mark_lanes(self, double[:, :, ::1] grid, Py_ssize_t layer, double x, double y) except *

@cython.final
cdef class Collisions:
    cdef Network _network
    cdef dict _lanes

    @cython.locals(costs="float[:, :, ::1]", network=Network, number=int, count=int, left=int, lane=int, x=double,
                   y=double, here=double, cos=double, sin=double, is_anywhere=bint, its_lane=int, heading=double,
                   speed=double, margin=double, projected=double, row=Py_ssize_t, wanted=double, closing=double,
                   point=Py_ssize_t, side=int, time=double, cost=double, cells_ahead=double, cell=Py_ssize_t)
    cpdef observe(self, ego, list vehicles, roads, double period, int cells)
